"""A user's effect, excitation and estimator, named in two ways, in whole experiments."""

from pathlib import Path
from typing import Any

import pytest

from sysid_bench.types import Row
from tests.experiments.experiment_world import CLOSED_LOOP, RICH, executed, spec

FILE = Path(__file__).parent / "plugins.py"
WAYS = {"module": "tests.experiments.plugins", "file": f"file:{FILE}"}


@pytest.fixture(params=WAYS)
def plugins(request: pytest.FixtureRequest) -> str:
    """Name of the module of plug-ins: dotted, or of a file."""
    return WAYS[request.param]


def only(rows: list[Row]) -> Row:
    (row,) = rows
    return row


def test_an_estimator(plugins: str) -> None:
    ols, ridge = executed(spec(), "ols", {"use": f"{plugins}:Ridge", "weight": 1e-10})
    assert ridge["status"] == "ok", ridge["reason"]
    assert ridge["stats"] == {"weight": 1e-10}
    assert ridge["torque_error"] < 1e-5
    assert ridge["condition"] == ols["condition"]


@pytest.mark.parametrize("simulation", [{"use": "inverse"}, CLOSED_LOOP], ids=str)
def test_an_effect(plugins: str, simulation: dict[str, str]) -> None:
    errors = []
    for size in ("0 N m", "0.5 N m", "5 N m"):
        plant = {"use": f"{plugins}:Drag", "size": size}
        row = only(executed(spec(robot=RICH, plant=plant, simulation=simulation), "ols"))
        assert row["status"] == "ok", row["reason"]
        errors.append(row["torque_error"])
    assert errors[0] < 1e-8
    assert errors[0] < errors[1] < errors[2]


def test_an_excitation(plugins: str) -> None:
    hops: dict[str, Any] = {"use": f"{plugins}:Hops", "duration": "6 s"}
    row = only(executed(spec(excitation=hops, held_out=(hops, {"use": "ptp"})), "ols"))
    assert row["status"] == "ok", row["reason"]
    assert row["torque_error"] < 1e-7
    assert list(row["torque_error_by_motion"]) == [hops["use"], "ptp"]


def test_a_wrong_setting_is_a_failed_row(plugins: str) -> None:
    plant = {"use": f"{plugins}:Drag", "size": "0.5 kg"}
    row = only(executed(spec(plant=plant), "ols"))
    assert row["status"] == "failed"
    assert "kg" in row["reason"]


def test_a_file_that_is_not_there_is_a_failed_row() -> None:
    row = only(executed(spec(excitation={"use": "file:nowhere.py:Hops"}), "ols"))
    assert row["status"] == "failed"
    assert "nowhere.py" in row["reason"]
