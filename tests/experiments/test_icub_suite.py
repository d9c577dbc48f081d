"""The shipped suite icub-ft, left arm: the figures that its report has to show."""

from functools import cache
from typing import Any

import pytest

from sysid_bench.experiments.spec import prior_seed
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.package_folders import suite
from tests.experiments.experiment_world import argument, rows_of


@cache
def planned() -> Plan:
    return cells_of_suite(load_suite(suite("icub-ft")))


@cache
def row(excitation: str, estimator: str, terms: str, noise: str, repeat: int) -> dict[str, Any]:
    wanted = {"robot": "icub @ l_arm", "excitation": excitation, "estimator": estimator,
              "terms": terms, "noise": noise}  # fmt: skip
    (cell,) = (
        c for c in planned().cells
        if c.spec.repeat == repeat and all(c.labels[k] == v for k, v in wanted.items())
    )  # fmt: skip
    return rows_of(argument(cell.spec, estimator))[0]


WHITE = "force 0.15 N, moment 0.008 N m"
ENCODERS = f"q 1e-4 rad, {WHITE}"


def draws() -> list[Cell]:
    return [
        cell for cell in planned().cells
        if cell.labels["robot"] == "icub @ l_arm" and cell.labels["noise"] == WHITE
        and cell.labels["estimator"] == "wls" and cell.labels["terms"] == "none"
    ]  # fmt: skip


@pytest.mark.long
def test_every_draw_has_noise_and_a_cad_model_of_its_own() -> None:
    assert len(draws()) == 30
    assert len({prior_seed(cell.spec) for cell in draws()}) == 30


@pytest.mark.parametrize("repeat", [0, pytest.param(7, marks=pytest.mark.long)])
def test_identified_parameters_serve_as_well_as_true_ones(repeat: int) -> None:
    arm = row("all joints", "wls", "none", WHITE, repeat)
    assert (arm["structural_rank"], arm["excited_rank"], arm["unpredictable"]) == (38, 38, 0)
    assert arm["sensed_torque_ratio"] < 1.02
    assert arm["sensed_wrench_ratio"] < 1.02
    assert arm["sensed_cad_ratio"] > 1.1
    assert arm["alone_cad_ratio"] < 0.05
    assert arm["beta_error"] < 2e-3
    noisy = row("all joints", "wls", "none", ENCODERS, repeat)
    assert noisy["beta_error"] < 4e-3


@pytest.mark.long
def test_a_locked_wrist_names_the_torques_that_its_data_cannot_foretell() -> None:
    arm = row("locked wrist", "lmi", "none", WHITE, 0)
    assert (arm["rank"], arm["excited_rank"], arm["structural_rank"]) == (38, 17, 38)
    assert arm["status"] == "ok"
    wrist = {"l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"}
    assert wrist <= set(arm["unpredictable_names"].split(", "))
    free = row("all joints", "lmi", "none", WHITE, 0)
    assert arm["alone_cad_ratio"] > 5 * free["alone_cad_ratio"]


def test_a_method_that_cannot_says_which_torques_are_missing() -> None:
    locked = next(c for c in planned().cells if c.labels["excitation"] == "locked wrist")
    rows = rows_of(argument(locked.spec, "wls"))
    assert rows[0]["status"] == "failed"
    assert rows[0]["excited_rank"] == 17
    assert "l_wrist_yaw are unpredictable" in rows[0]["reason"]
