"""Last bits of the data: a method that stops by rounding is found, an ordinary one is not."""

from typing import Any

import numpy as np
import pytest

from sysid_bench.commands.cells import SAME, difference_text
from sysid_bench.experiments.cell_data import SIZE, near_experiment, repeat_cells
from sysid_bench.experiments.spec import ExperimentSpec
from tests.experiments.experiment_world import CLOSED_LOOP, SMOOTH, argument, dense, ready, spec
from tests.experiments.plugins import Halving

NOISE = {"q": 1e-5, "tau_relative": 0.01}
HALVING = "tests.experiments.plugins:Halving"


def differences(made: ExperimentSpec, *estimators: Any, repeats: int = 8) -> list[str]:
    """Effect of other last bits on the answers of each estimator."""
    asked = {"job": argument(made, *estimators), "repeats": repeats}
    return [difference_text(rows) for rows in repeat_cells(asked).values()]


@pytest.mark.parametrize("robot", ["ur5", "scara", "z1"])
@pytest.mark.parametrize("seed", [1])
def test_an_iteration_that_stops_by_rounding_is_found(robot: str, seed: int) -> None:
    made = spec(robot=robot, seed=seed, noise=NOISE)
    on_edge = Halving().residual(ready(robot=robot, seed=seed, noise=NOISE).problem, steps=3)
    edge, above = differences(
        made, {"use": HALVING, "limit": on_edge}, {"use": HALVING, "limit": 1.001 * on_edge}
    )
    assert "torque_error" in edge
    assert "iterations 3 or 4" in edge or "iterations 4 or 3" in edge
    assert above == SAME


@pytest.mark.parametrize("robot", ["scara", "z1"])
def test_ordinary_methods_are_not(robot: str) -> None:
    methods = ("ols", "wls", "irls", "huber", "lmi")
    assert differences(spec(robot=robot, noise=NOISE), *methods) == [SAME] * len(methods)


def test_nor_are_methods_that_simulate() -> None:
    made = spec(robot=SMOOTH, noise=NOISE, simulation=CLOSED_LOOP, prior={"mass": 0.05})
    assert differences(made, "didim", repeats=2) == [SAME]


def test_data_change_by_the_stated_size_alone_and_the_same_with_each_reading() -> None:
    data = ready(noise=NOISE).experiment
    for seed in range(3):
        other = near_experiment(data, seed)
        pairs = [(data.raw.tau, other.raw.tau), (data.recording.q, other.recording.q)]
        pairs += zip(dense(data.problem), dense(other.problem), strict=True)
        for before, after in pairs:
            assert not np.array_equal(before, after)
            assert (np.abs(after - before) <= 2 * SIZE * np.abs(before)).all()
        for first, second in zip(dense(other.problem), dense(other.problem), strict=True):
            np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"status": "failed"}, "status ok or failed"),
        ({"converged": False}, "converged True or False"),
        ({"stop": "limit"}, "stop small step or limit"),
        ({"torque_error": 0.1001}, "torque_error 0.1 to 0.1001"),
        ({"torque_error": 0.1 + 1e-12}, SAME),
        ({"iterations": 9}, SAME),  # with the same answer
    ],
)
def test_what_differs_is_named(other: dict[str, Any], text: str) -> None:
    row = {"status": "ok", "converged": True, "stop": "small step", "iterations": 8}
    row |= {"torque_error": 0.1, "condition": 100.0}
    assert difference_text([row, row, row | other]) == text
