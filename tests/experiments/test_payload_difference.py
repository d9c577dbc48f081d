"""The payload from recordings of one motion with and without it: errors of the arm cancel."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.identification.estimators.linear import WLS, Difference
from sysid_bench.identification.identify import identify
from sysid_bench.types import Estimate
from tests.experiments.experiment_world import CLOSED_LOOP, ready

ARMS = ("ur5", "scara", "z1", "random:7")
PRIOR = {"mass": 0.2, "com": 0.015, "inertia": 0.3}
PLAIN = {"filter": "none", "derivatives": "exact"}


@cache
def made(
    robot: str, runs: str = "AB", known: float = 0.3, **noise: float
) -> ExperimentData[SimulatedSource]:
    """A payload experiment with recordings in this order; with errors in the known arm."""
    return ready(
        robot=robot, payload="box-2kg", task="payload", prior=PRIOR | {"known": known},
        signals=PLAIN | {"runs": runs}, noise=noise,
    )  # fmt: skip


def answer(at: ExperimentData[SimulatedSource], estimator: object) -> Estimate:
    estimate = identify(estimator, at.problem, at.experiment)
    assert estimate.status == "ok", estimate.reason
    return estimate


def error(at: ExperimentData[SimulatedSource], estimate: Estimate) -> float:
    truth = at.problem.base.K @ at.source.truth.theta
    assert estimate.beta is not None
    return float(np.linalg.norm(estimate.beta - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("robot", ARMS)
@pytest.mark.parametrize("runs", ["AB", "BA", "ABBA"])
def test_exact_data_give_the_exact_payload_whatever_is_known_of_the_arm(
    robot: str, runs: str
) -> None:
    at = made(robot, runs)
    assert error(at, answer(at, Difference())) <= 1e-8
    assert error(at, answer(at, WLS())) > 1e-2  # the known arm is wrong


@pytest.mark.parametrize("robot", ARMS)
def test_a_linear_drift_cancels_in_abba_and_in_no_other_order(robot: str) -> None:
    drifting = {runs: made(robot, runs, tau_drift=0.05) for runs in ("ABBA", "AB", "AABB")}
    errors = {runs: error(at, answer(at, Difference())) for runs, at in drifting.items()}
    assert errors["ABBA"] <= 1e-8
    assert min(errors["AB"], errors["AABB"]) > 1e-4


def scored(at: ExperimentData[SimulatedSource], estimator: object) -> Any:
    return score(answer(at, estimator), at.problem, at.held_out, at.source.truth)


@pytest.mark.parametrize("robot", ["ur5", "z1"])
def test_with_noise_it_beats_a_fit_with_a_wrong_arm_and_not_one_with_a_right_arm(
    robot: str,
) -> None:
    """Costs of two noisy recordings, and of masses that are wrong by a tenth."""
    wrong = made(robot, "AB", known=0.1, tau_relative=0.01)
    right = made(robot, "AB", known=0.0, tau_relative=0.01)
    difference, misled = (scored(wrong, method).payload_error for method in (Difference(), WLS()))
    error = scored(right, WLS()).payload_error
    assert difference < 0.5 * misled
    assert error < 2.0 * difference


@pytest.mark.parametrize("robot", ["ur5", "scara"])
def test_a_loop_that_moves_the_bare_arm_otherwise_is_corrected_by_what_is_known(robot: str) -> None:
    errors = []
    for known in (0.0, 0.1):
        at = ready(
            robot=robot, payload="box-2kg", task="payload", prior=PRIOR | {"known": known},
            signals=PLAIN | {"runs": "AB"}, simulation=CLOSED_LOOP,
        )  # fmt: skip
        errors.append((error(at, answer(at, Difference())), error(at, answer(at, WLS()))))
    assert errors[1][0] < 0.5 * errors[1][1]


def test_the_order_is_kept_and_the_first_loaded_run_is_the_recording() -> None:
    at = made("ur5", "ABBA", tau_relative=0.01)
    assert [run.loaded for run in at.experiment.runs] == [False, True, True, False]
    assert at.experiment.runs[1].recording is at.experiment.recording
    taus = [run.recording.tau for run in at.experiment.runs]
    assert not np.array_equal(taus[1], taus[2])  # noise of its own
    alone = made("ur5", "B", tau_relative=0.01)
    assert alone.experiment.runs == ()
    np.testing.assert_array_equal(alone.experiment.recording.tau, taus[1])


def test_without_bare_runs_or_a_payload_it_says_what_to_do() -> None:
    at = made("ur5", "B")
    estimate = identify(Difference(), at.problem, at.experiment)
    assert estimate.status == "unsupported"
    assert 'runs = "AB"' in estimate.reason
    with pytest.raises(UnsupportedError, match="task is 'robot'"):
        ready(robot="ur5", signals=PLAIN | {"runs": "AB"})
