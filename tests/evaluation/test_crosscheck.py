"""The verdict holds for every robot, and falls when either side is tampered with."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid_bench.evaluation import crosscheck as module
from sysid_bench.evaluation.crosscheck import (
    CLOSURE,
    GAP,
    Crosscheck,
    crosscheck,
    simulation_gap,
)
from sysid_bench.regressors import kernel_numpy as kernel
from sysid_bench.regressors.kernel_c import KernelSelection
from sysid_bench.simulation.plant_batch import PlantBatch, lanes_library
from sysid_bench.types import Array
from tests.experiments.experiment_world import OWN, SHIPPED, robot_of
from tests.robots import NAMED, named_robot

Columns = tuple[tuple[tuple[int, Array], ...], ...]
Change = Callable[[list[Any]], None]


@pytest.mark.parametrize("payload", ["none", "sphere-offset-1kg"])
@pytest.mark.parametrize("name", SHIPPED + OWN)
def test_both_engines_agree_on_every_robot(name: str, payload: str) -> None:
    check = crosscheck(robot_of(name, payload), samples=20)
    assert check.ok()
    assert check.reason() == ""
    assert check.gap_map.shape == (robot_of(name, payload).nv, len(check.columns))
    assert (check.native_gap is None) == bool(check.native_reason)


def swap(one: int, other: int) -> Change:
    def change(columns: list[Any]) -> None:
        columns[one], columns[other] = columns[other], columns[one]

    return change


def scale(column: int, factor: float) -> Change:
    def change(columns: list[Any]) -> None:
        columns[column] = tuple((row, factor * value) for row, value in columns[column])

    return change


CHANGES: dict[str, Change] = {
    "Iyy and Ixz swapped": swap(7, 6),
    "hx and hy swapped": swap(1, 2),
    "a sign of Ixy": scale(5, -1.0),
    "Izz a little larger": scale(9, 1 + 1e-9),
    "mass a little smaller": scale(0, 1 - 1e-9),
    "Ixx forgotten": scale(4, 0.0),
    "hz is not a number": scale(3, np.nan),
}


@pytest.mark.parametrize("name", ["ur5", "panda", "file:ball.xml"])
@pytest.mark.parametrize("what", CHANGES)
def test_a_tampered_body_regressor_is_caught(
    what: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = vars(kernel)["entries"]

    def tampered(w: Array, alpha: Array, d: Array) -> Columns:
        columns = list(honest(w, alpha, d))
        CHANGES[what](columns)
        return tuple(columns)

    monkeypatch.setattr(kernel, "entries", tampered)
    monkeypatch.setattr(
        "sysid_bench.regressors.regression.select_kernel", lambda: KernelSelection(None, "a test")
    )
    check = crosscheck(robot_of(name), samples=10)
    assert not check.ok()
    assert "gap" in check.reason()
    assert not check.ok(1e-10)


def test_a_reference_that_says_something_else_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = robot_of("ur5")
    honest = vars(module)["reference_regressor"]

    def permuted(robot: Any, motion: Any) -> Any:
        made = honest(robot, motion)
        return replace(made, Y=made.Y[:, ::-1])

    monkeypatch.setattr(module, "reference_regressor", permuted)
    assert not crosscheck(robot, samples=5).ok()


def test_a_plant_that_moves_otherwise_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = vars(module)["inverse_torque"]
    monkeypatch.setattr(module, "inverse_torque", lambda r, m: honest(r, m) * (1 + 1e-9))
    check = crosscheck(robot_of("ur5"), samples=5)
    assert check.gap <= GAP
    assert not check.closure <= CLOSURE
    assert not check.ok()
    assert check.reason().startswith("closure")


@pytest.mark.parametrize("name", NAMED)
def test_steps_of_every_robot_are_those_of_mujoco(name: str) -> None:
    apart, reason = simulation_gap(named_robot(name).without_coupling)
    if isinstance(lanes_library(), str):
        assert apart is None
        assert reason == lanes_library()
        return
    assert reason == ""
    assert apart is not None
    assert apart <= 1e-12


def test_steps_that_move_otherwise_are_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    if isinstance(lanes_library(), str):
        pytest.skip(lanes_library())
    honest = PlantBatch.run
    monkeypatch.setattr(
        PlantBatch, "run", lambda batch: replace(honest(batch), q=honest(batch).q + 2e-9)
    )
    check = crosscheck(robot_of("ur5"), samples=5)
    assert not check.ok()
    assert check.reason().startswith("simulation gap")


def made(gap: float = 0.0, closure: float = 0.0, native: float | None = None) -> Crosscheck:
    return Crosscheck(gap, closure, native, "", np.zeros((1, 10)), ("m",))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e-6])
def test_what_is_no_small_number_never_passes(bad: float) -> None:
    assert made().ok()
    assert made(native=0.0).ok()
    for check in (made(gap=bad), made(closure=bad), made(native=bad)):
        assert not check.ok()
        assert check.reason()


def test_a_tolerance_of_zero_passes_only_what_is_bit_equal() -> None:
    assert made().ok(0.0)
    assert not made(gap=1e-300).ok(0.0)
