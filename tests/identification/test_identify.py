"""`identify` always returns an estimate: mistakes of a plug-in become a status and a reason."""

import hashlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError, UsageError
from sysid_bench.identification.estimators.linear import OLS, WLS
from sysid_bench.identification.identify import identify
from sysid_bench.plugin_names import build
from sysid_bench.types import Estimate, Experiment, Problem
from tests.experiments.experiment_world import ready, ready_once


def answered(**given: Any) -> Estimate:
    """An Estimate as a plug-in author makes it: outside of tests nothing checks its shapes."""
    estimate = Estimate()
    for name, value in given.items():
        object.__setattr__(estimate, name, value)
    return estimate


class Solve:
    """A linear method that returns a given result."""

    def __init__(self, answer: Callable[[Problem], Any]) -> None:
        self.answer = answer

    def solve(self, problem: Problem) -> Any:
        return self.answer(problem)


def raising(error: BaseException) -> Callable[[Problem], Any]:
    def answer(problem: Problem) -> Any:
        raise error

    return answer


def problem() -> Problem:
    return ready_once("ur5").problem


def beta_like(change: Callable[[np.ndarray], Any]) -> Callable[[Problem], Estimate]:
    return lambda problem: answered(beta=change(np.ones(problem.base.rank)))


def with_nan(beta: np.ndarray) -> np.ndarray:
    beta[[0, 2]] = np.nan, np.inf
    return beta


BAD: dict[str, tuple[Callable[[Problem], Any], str]] = {
    "nothing": (lambda p: None, "NoneType"),
    "an array": (lambda p: np.ones(p.base.rank), "ndarray"),
    "empty": (lambda p: Estimate(), "neither beta nor theta"),
    "short": (beta_like(lambda b: b[:-1]), "shape"),
    "a column": (beta_like(lambda b: b[:, None]), "shape"),
    "a number": (beta_like(lambda b: 3.0), "shape"),
    "not finite": (beta_like(with_nan), "2 of 48"),
    "complex": (beta_like(lambda b: b + 1j), "not real numbers"),
    "words": (beta_like(lambda b: ["a"] * len(b)), "not real numbers"),
    "short theta": (lambda p: Estimate(theta=np.ones(3)), "theta"),
    "theta of NaN": (lambda p: Estimate(theta=np.full(len(p.parameters), np.nan)), "theta"),
    "bogus status": (lambda p: answered(beta=np.ones(48), status="good"), "'good'"),
    "covariance": (lambda p: answered(beta=np.ones(48), covariance=np.eye(3)), "covariance"),
    "covariance of NaN": (
        lambda p: answered(beta=np.ones(48), covariance=np.full((48, 48), np.nan)),
        "covariance",
    ),
    "negative variance": (
        lambda p: answered(beta=np.ones(48), covariance=-np.eye(48)),
        "negative",
    ),
    "EstimationError": (raising(EstimationError("too little")), "too little"),
    "SimulationError": (raising(SimulationError("it fell")), "it fell"),
    "UsageError": (raising(UsageError("no such word")), "no such word"),
    "singular": (raising(np.linalg.LinAlgError("Singular matrix")), "Singular"),
}


@pytest.mark.parametrize("what", BAD)
def test_an_invalid_estimate_fails_with_a_reason(what: str) -> None:
    answer, words = BAD[what]
    estimate = identify(Solve(answer), problem())
    assert estimate.status == "failed"
    assert words in estimate.reason
    assert estimate.stats["seconds"] >= 0


def test_unsupported_is_a_status_of_its_own() -> None:
    estimate = identify(Solve(raising(UnsupportedError("needs a wrist"))), problem())
    assert (estimate.status, estimate.reason) == ("unsupported", "needs a wrist")


def test_a_method_may_return_a_failure() -> None:
    said = Estimate(status="failed", reason="no minimum", stats={"iterations": 7.0})
    estimate = identify(Solve(lambda p: said), problem())
    assert (estimate.status, estimate.reason) == ("failed", "no minimum")
    assert estimate.stats["iterations"] == 7.0
    assert set(said.stats) == {"iterations"}  # the method's own answer is left alone


def test_other_exceptions_of_a_plug_in_pass_through() -> None:
    with pytest.raises(ZeroDivisionError):
        identify(Solve(raising(ZeroDivisionError("1/0"))), problem())


def test_an_object_without_solve_or_fit_fails() -> None:
    estimate = identify(object(), problem())
    assert estimate.status == "failed"
    assert "neither solve" in estimate.reason


class Fit:
    def fit(self, experiment: Experiment) -> Estimate:
        return Estimate(np.zeros(experiment.problem.base.rank))


def test_a_method_that_simulates_needs_an_experiment() -> None:
    assert identify(Fit(), problem()).status == "unsupported"
    assert identify(Fit(), problem(), ready_once("ur5").experiment).status == "ok"


def test_theta_alone_gives_beta() -> None:
    theta = np.random.default_rng(0).normal(size=len(problem().parameters))
    estimate = identify(Solve(lambda p: Estimate(theta=theta)), problem())
    assert estimate.status == "ok"
    assert estimate.beta is not None
    np.testing.assert_array_equal(estimate.beta, problem().base.K @ theta)


def test_theta_decides_where_both_are_given() -> None:
    theta = np.ones(len(problem().parameters))
    both = Estimate(beta=np.zeros(problem().base.rank), theta=theta)
    estimate = identify(Solve(lambda p: both), problem())
    assert estimate.beta is not None
    np.testing.assert_array_equal(estimate.beta, problem().base.K @ theta)


def test_lists_of_numbers_are_numbers() -> None:
    estimate = identify(Solve(beta_like(lambda b: b.tolist())), problem())
    assert estimate.status == "ok"
    assert isinstance(estimate.beta, np.ndarray)


def test_flags_and_counts_of_numpy_are_flags_and_counts() -> None:
    def solve(given: Problem) -> Estimate:
        return answered(
            beta=np.zeros(given.base.rank), converged=np.bool_(True), iterations=np.int64(3)
        )

    estimate = identify(Solve(solve), problem())
    assert estimate.status == "ok", estimate.reason
    assert estimate.converged is True
    assert type(estimate.iterations) is int


@pytest.mark.parametrize("wrong", [{"converged": 1}, {"iterations": True}, {"iterations": 2.5}])
def test_a_flag_or_count_of_another_type_fails(wrong: dict[str, Any]) -> None:
    solve = Solve(lambda p: answered(beta=np.zeros(p.base.rank), **wrong))
    estimate = identify(solve, problem())
    assert estimate.status == "failed"
    assert "expected" in estimate.reason


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ({"use": "entropic", "weights": "rms"}, "rms-torque"),
        ({"use": "didim", "gains": "keep"}, "kept"),
        ({"use": "didim", "iterations": 0}, "1 or more"),
        ({"use": "iv", "iterations": 0}, "1 or more"),
    ],
    ids=str,
)
def test_wrong_settings_are_refused_before_anything_runs(spec: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        build("estimator", spec)


def arrays(value: Any) -> list[np.ndarray]:
    """All arrays of a value, in order."""
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, partial):
        value = value.args
    if isinstance(value, (tuple, list)):
        return [array for part in value for array in arrays(part)]
    if is_dataclass(value):
        return [array for f in fields(value) for array in arrays(getattr(value, f.name))]
    return []


def fingerprint(value: Any) -> str:
    """Hash of all arrays of a value."""
    total = hashlib.sha256()
    for array in arrays(value):
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


@pytest.mark.parametrize("estimator", [OLS(), WLS(), WLS(iterations=3)], ids=str)
def test_the_input_is_unchanged_and_the_estimate_deterministic(estimator: OLS | WLS) -> None:
    experiment = ready(noise={"tau_relative": 0.01, "q": 1e-4}).experiment
    before = fingerprint(experiment)
    assert len(arrays(experiment)) > 30
    first = identify(estimator, experiment.problem, experiment)
    second = identify(estimator, experiment.problem, experiment)
    assert fingerprint(experiment) == before
    assert first.beta is not None
    np.testing.assert_array_equal(first.beta, second.beta)
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_no_method_can_change_the_data_of_the_next() -> None:
    experiment = ready(noise={"tau_relative": 0.01}).experiment
    for array in arrays(experiment.problem.factors) + arrays(experiment.recording):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
