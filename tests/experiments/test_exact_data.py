"""Exact data and the matched plant: every robot's parameters are found to rounding."""

from typing import Any

import numpy as np
import pytest

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.identification.estimators.linear import OLS
from tests.experiments.dropped_bound import dropped_bound
from tests.experiments.experiment_world import (
    CLOSED_LOOP,
    OWN,
    RICH,
    SHIPPED,
    SMOOTH,
    ready,
    ready_once,
    smooth_loop,
    solved,
)


def figures(made: ExperimentData[Any]) -> Any:
    estimate, scores = solved(made, OLS())
    assert estimate.status == "ok", estimate.reason
    return scores


@pytest.mark.parametrize("payload", ["none", "sphere-offset-1kg", "point-1kg", "rod-1kg"])
@pytest.mark.parametrize("name", SHIPPED + OWN)
def test_every_robot_with_every_load_is_found(name: str, payload: str) -> None:
    made = ready_once(name, payload)
    errors = figures(made)
    # Near-degenerate directions are in the data and in no base parameter.
    bound = dropped_bound(made.problem, made.held_out, made.source.truth.theta)
    assert errors.beta_error <= 1e-9 + bound.beta_error
    assert errors.torque_error <= 1e-9 + bound.torque_error


def test_only_near_degenerate_directions_widen_the_bound() -> None:
    for name in SHIPPED:
        made = ready_once(name)
        bound = dropped_bound(made.problem, made.held_out, made.source.truth.theta)
        degenerate = made.problem.base.near_degenerate > 0
        assert (bound.beta_error > 0, bound.torque_error > 0) == (degenerate, degenerate)
        assert bound.beta_error < 0.01
        assert bound.torque_error < 0.01


@pytest.mark.parametrize("task", ["payload", "link"])
@pytest.mark.parametrize("name", OWN)
def test_loads_of_robots_with_ball_and_free_joints_are_found(name: str, task: str) -> None:
    """The terms of ball and free joints are known in all three directions."""
    scores = figures(ready_once(name, "sphere-offset-1kg", task))
    assert scores.beta_error <= 1e-8


TERMS = ("viscous", "coulomb", "offset", "armature", "spring")


@pytest.mark.parametrize("terms", [(), *((term,) for term in TERMS), TERMS], ids=str)
@pytest.mark.parametrize("name", ["ur5", RICH])
def test_any_choice_of_terms_is_found_the_rest_being_known(
    name: str, terms: tuple[str, ...]
) -> None:
    scores = figures(ready(robot=name, terms=terms))
    assert scores.beta_error <= 1e-9


def test_closed_loop_data_are_as_exact() -> None:
    for made in (smooth_loop(), ready(robot=RICH, simulation=CLOSED_LOOP)):
        scores = figures(made)
        assert scores.beta_error <= 1e-7  # through the condition number of a motion not designed
        assert scores.torque_error <= 1e-9


@pytest.mark.parametrize("payload", ["none", "box-2kg"])
def test_what_is_known_and_what_is_asked_make_the_measured_torque(payload: str) -> None:
    for task in ("robot", "payload") if payload != "none" else ("robot", "link"):
        made = ready_once("panda", payload, task)
        beta = made.problem.base.K @ made.source.truth.theta
        blocks = made.experiment.regress(made.experiment.recording.motion)
        predicted = np.concatenate([block @ beta for block in blocks]) + made.source.known
        np.testing.assert_allclose(predicted, made.experiment.recording.tau, atol=1e-9)


def test_rows_of_a_problem_can_be_walked_again_and_again() -> None:
    problem = ready_once("ur5").problem
    (first, second) = (list(problem.blocks()) for _ in range(2))
    for (Y1, b1), (Y2, b2) in zip(first, second, strict=True):
        np.testing.assert_array_equal(Y1, Y2)
        np.testing.assert_array_equal(b1, b2)
    factor = problem.factors[2]
    W = np.concatenate([Y[:, 2][:, factor.columns] for Y, _ in first])
    b = np.concatenate([b[:, 2] for _, b in first])
    gram = np.column_stack([W, b]).T @ np.column_stack([W, b])
    np.testing.assert_allclose(factor.R.T @ factor.R, gram, atol=1e-9 * np.abs(gram).max())


def test_smooth_is_without_coulomb_friction() -> None:
    assert not ready_once(SMOOTH).robot.joint_terms.coulomb.any()
