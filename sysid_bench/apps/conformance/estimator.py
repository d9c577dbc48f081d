"""Conformance kits of estimators and of metrics, on small simulated experiments.

The laws of estimators: exact data give the true parameters; the result is deterministic,
equivariant under changes of unit and invariant to the order of the joints; the input stays
unchanged; a failure has a reason; and the estimate depends on the data, not only on the prior.
Those of metrics are in `evaluation.metric_checks`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import Finding, Kit, Laws, failed_checks
from sysid_bench.evaluation.metric_checks import check_metric
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import stacked_factor
from sysid_bench.types import (
    Array,
    Estimate,
    Experiment,
    Factor,
    Metric,
    MetricInput,
    Prior,
    Problem,
    RowBlock,
)

# `replace` makes a new object each time, so that the cached `Problem.stacked` is not inherited.


def scaled_problem(problem: Problem, regressor: float = 1.0, torque: float = 1.0) -> Problem:
    """The problem (regressor W) beta = torque b, in R factors and blocks alike."""
    factors = tuple(
        replace(f, R=f.R * np.append(np.full(len(f.columns), regressor), torque))
        for f in problem.factors
    )
    blocks = partial(_scaled, problem.blocks, regressor, torque)
    return replace(problem, factors=factors, blocks=blocks)


def scaled_prior(problem: Problem, factor: float) -> Problem:
    """The problem with its prior mean and standard deviations times `factor`."""
    if problem.prior is None:
        return problem
    return replace(problem, prior=Prior(factor * problem.prior.theta, factor * problem.prior.std))


def rows_from_end(problem: Problem) -> Problem:
    """The problem with its rows (joints) in reverse order."""
    return replace(
        problem,
        rows=problem.rows[::-1],
        factors=problem.factors[::-1],
        kinds=problem.kinds[::-1],
        blocks=partial(_reversed, problem.blocks),
    )


def first_samples(problem: Problem, samples: int) -> Problem:
    """The problem of the first `samples` samples."""
    Y, b = next(iter(problem.blocks()))
    Y, b = Y[:samples].copy(), b[:samples].copy()
    factors = []
    for i, factor in enumerate(problem.factors):
        # R of [W b] holds all that least squares need: R^T R = [W b]^T [W b].
        stack = np.column_stack([Y[:, i, factor.columns], b[:, i]])
        R = np.asarray(np.linalg.qr(stack, mode="r"))
        factors.append(Factor(factor.row, factor.columns, R, len(b)))
    blocks = partial(_one_block, Y, b)
    return replace(problem, factors=tuple(factors), blocks=blocks, samples=len(b))


def _scaled(
    blocks: Callable[[], Iterator[RowBlock]], regressor: float, torque: float
) -> Iterator[RowBlock]:
    for Y, b in blocks():
        yield regressor * Y, torque * b


def _reversed(blocks: Callable[[], Iterator[RowBlock]]) -> Iterator[RowBlock]:
    for Y, b in blocks():
        yield Y[:, ::-1], b[:, ::-1]


def _one_block(Y: Array, b: Array) -> Iterator[RowBlock]:
    yield Y, b


EXACT: Final = 1e-8
"""Largest |beta - beta*| / |beta*| of a consistent method on exact data."""

SAME: Final = 1e-5
"""Largest relative difference between the torques of two estimates that have to agree."""

UNMOVED: Final = 1e-9
"""Relative distance below which an estimate equals the (wrong) prior, or zero."""


@dataclass(frozen=True, eq=False)
class TestProblem:
    """An identification problem with known parameters `theta` (p,); `exact` where its data have no
    noise, `experiment` for methods that simulate."""

    # Its name starts with Test: pytest is not to collect it.
    __test__ = False

    name: str
    problem: Problem
    theta: Array
    exact: bool
    experiment: Experiment | None = None


def check(estimator: Any, cases: Sequence[TestProblem]) -> list[Finding]:
    """Findings of all laws on all cases; an exception of the estimator violates the law that met
    it."""
    estimates: list[Estimate] = []

    def run(estimator: Any, case: TestProblem) -> Estimate:
        estimates.append(_estimate(estimator, case))
        return estimates[-1]

    kit = Kit(
        runs="returns an estimate",
        run=run,
        laws=lambda case, first: (ESTIMATOR_LAWS,),
        given=lambda case: (case.problem, case.experiment),
        changed="it changed an array of the problem",
    )
    findings = kit.findings(estimator, cases)
    # A method that fails on every problem would keep all laws.
    if not any(estimate.status == "ok" for estimate in estimates):
        given = "; ".join(dict.fromkeys(one.reason for one in estimates if one.reason))
        message = "it solved none of the problems" + (f": {given}" if given else "")
        findings.append(Finding("returns an estimate", "all problems", False, message))
    return findings


def assert_conforms(estimator: Any, cases: Sequence[TestProblem]) -> None:
    """Raise AssertionError with all violated laws of an estimator; for tests."""
    lines = failed_checks(check(estimator, cases))
    if lines:
        raise AssertionError(f"{estimator!r} violates {len(lines)} laws:\n" + "\n".join(lines))


def _estimate(estimator: Any, case: TestProblem) -> Estimate:
    return identify(estimator, case.problem, case.experiment)


def _recovers_exact_parameters(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """Exact data give the true parameters; a method biased by design declares `bias`."""
    if not case.exact or _bias(estimator):
        return None
    if first.beta is None or first.status != "ok":
        return None
    # beta = K theta: base parameters are sums of the standard ones.
    truth = case.problem.base.K @ case.theta
    error = _relative(first.beta - truth, truth)
    if error <= EXACT:
        return None
    return (
        f"exact data give beta with a relative error of {error:.1e}; {EXACT:.0e} is allowed. A "
        "method biased by design describes its bias in a class attribute 'bias'"
    )


def _is_deterministic(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """The same problem gives the same estimate, bit for bit."""
    second = _estimate(estimator, case)
    if first.status != second.status:
        return f"its status is {first.status!r} in the first call and {second.status!r} in the next"
    for name in ("beta", "theta", "covariance"):
        if not np.array_equal(_array(first, name), _array(second, name)):
            return f"{name} differs from one call to the next"
    return None


def _is_invariant_to_torque_units(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """W and b times a factor: the same parameters."""
    # Powers of two change exponents alone: both forms of the problem have the same rounding.
    factor = 4.0
    scaled = scaled_problem(case.problem, regressor=factor, torque=factor)
    return _differs(estimator, case, first, scaled, 1.0)


def _is_equivariant_to_mass_units(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """b and the prior times a factor: the parameters times that factor."""
    factor = 2.0
    scaled = scaled_prior(scaled_problem(case.problem, torque=factor), factor)
    return _differs(estimator, case, first, scaled, factor)


def _is_invariant_to_joint_order(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """Rows in reverse order: the same parameters."""
    return _differs(estimator, case, first, rows_from_end(case.problem), 1.0)


def _gives_a_reason_on_failure(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """One sample excites almost nothing: the estimate is finite or has a status with a reason."""
    if not hasattr(estimator, "solve"):
        return None
    for estimate in (first, identify(estimator, first_samples(case.problem, 1))):
        if estimate.status != "ok" and len(estimate.reason.split()) < 3:
            return f"its status is {estimate.status!r} and its reason {estimate.reason!r}"
    return None


def _refuses_unexcited_parameters(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """One sample without a prior determines fewer base parameters than there are. A method that
    returns all of them has added information: it declares `bias` or returns `theta`."""
    if not hasattr(estimator, "solve"):
        return None
    # A prior would be a reason to return every parameter.
    problem = replace(first_samples(case.problem, 1), prior=None)
    # As many equations as unknowns could determine all of them.
    if len(problem.rows) >= problem.base.rank:
        return None
    estimate = identify(estimator, problem)
    if estimate.status != "ok" or _bias(estimator) or estimate.theta is not None:
        return None
    return "it returns all base parameters from one sample without a prior, and declares no 'bias'"


def _uses_the_data(estimator: Any, case: TestProblem, first: Estimate) -> str | None:
    """The estimate is neither zero nor the prior, which is wrong here; that of a null model, which
    declares `uses_data = False`, is the prior."""
    if first.status != "ok" or first.beta is None:
        return None
    problem = case.problem
    if not getattr(estimator, "uses_data", True):
        return _is_the_prior(problem, first.beta)
    if _relative(first.beta, problem.base.K @ case.theta) <= UNMOVED:
        return "its estimate is zero"
    if problem.prior is None:
        return None
    start = problem.base.K @ problem.prior.theta
    if _relative(first.beta - start, start) <= UNMOVED:
        return "its estimate is the prior: a fit that stays at its start has failed"
    return None


def _is_the_prior(problem: Problem, beta: Array) -> str | None:
    """Law of a null model."""
    if problem.prior is None:
        return "it declares uses_data = False, and has an estimate without a prior"
    start = problem.base.K @ problem.prior.theta
    if _relative(beta - start, start) <= UNMOVED:
        return None
    return "it declares uses_data = False, and its estimate is not the prior"


ESTIMATOR_LAWS: Final[Laws] = {
    "recovers exact parameters": _recovers_exact_parameters,
    "is deterministic": _is_deterministic,
    "is invariant to the unit of torque": _is_invariant_to_torque_units,
    "is equivariant to the unit of mass": _is_equivariant_to_mass_units,
    "is invariant to the order of joints": _is_invariant_to_joint_order,
    "gives a reason on failure": _gives_a_reason_on_failure,
    "refuses unexcited parameters": _refuses_unexcited_parameters,
    "uses the data": _uses_the_data,
}


def _differs(
    estimator: Any, case: TestProblem, one: Estimate, other: Problem, factor: float
) -> str | None:
    """Violation where the solution of `other` is not `factor` times the first one."""
    if not hasattr(estimator, "solve"):
        return None
    two = identify(estimator, other)
    if one.status != two.status:
        return (
            f"its status is {one.status!r} in one form of the problem and {two.status!r} in another"
        )
    if one.beta is None or two.beta is None or one.status != "ok":
        return None
    # In torques rather than in beta: weakly excited directions may differ by more.
    R = stacked_factor(case.problem)[:-1, :-1]
    error = _relative(R @ (two.beta / factor - one.beta), R @ one.beta)
    return None if error <= SAME else f"the torques of the two estimates differ by {error:.1e}"


def _bias(estimator: Any) -> str:
    return str(getattr(estimator, "bias", ""))


def _relative(difference: Array, reference: Array) -> float:
    return float(np.linalg.norm(difference)) / max(float(np.linalg.norm(reference)), 1e-300)


def _array(estimate: Estimate, name: str) -> Array:
    value = getattr(estimate, name)
    return np.zeros(0) if value is None else np.asarray(value)


LINEAR: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7"},
    {"robot": "random:12", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5"},
    {"robot": "z1", "noise": {"tau_relative": 0.01}, "prior": "none"},
    {"robot": "panda", "task": "payload", "payload": "box-2kg"},
    {"robot": "ur10", "task": "link", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""Exact and noisy data, whole robots and single bodies, with and without a prior."""

CLOSED_LOOP: Final[Mapping[str, Any]] = {
    "robot": "random:94",
    "simulation": {"use": "closed-loop", "rate": 500.0, "substeps": 1},
    "rate": 100.0,
}
"""Experiment of methods that simulate: a declared controller, and joints without Coulomb friction,
which would stick, so that exact data would not give the true parameters."""

_DEFAULTS: Final[Mapping[str, Any]] = {
    "seed": 1,
    "payload": "none",
    "task": "robot",
    "terms": None,
    "plant": {"use": "matched"},
    "prior": {"mass": 0.2, "com": 0.015, "inertia": 0.3, "terms": 0.3},
    "excitation": {"use": "fourier", "period": "4 s", "cycles": 1},
    "held_out": (),
    "simulation": {"use": "inverse"},
    "rate": 30.0,
    "noise": {},
    "signals": {"filter": "none", "derivatives": "exact"},
    "repeat": 0,
}


def estimator_problems(
    simulating: bool = False, robots_dir: Path | None = None
) -> tuple[TestProblem, ...]:
    """Test problems of linear methods, or of methods that simulate; a new object each time."""
    if simulating:
        # Exact data show a bias, noisy ones that the method does not need exact data.
        noisy = {**CLOSED_LOOP, "noise": {"tau_relative": 0.01}}
        return tuple(_problem(changes, robots_dir) for changes in (CLOSED_LOOP, noisy))
    return tuple(_problem(changes, robots_dir) for changes in LINEAR)


@cache
def estimator_cases(simulating: bool) -> tuple[TestProblem, ...]:
    """`estimator_problems`, made once per process."""
    return estimator_problems(simulating)


def experiment_spec(changes: Mapping[str, Any]) -> ExperimentSpec:
    """Specification of a small experiment of one short motion, with some fields changed."""
    return ExperimentSpec(**{**_DEFAULTS, **changes})


def _problem(changes: Mapping[str, Any], robots_dir: Path | None) -> TestProblem:
    spec = experiment_spec(changes)
    robots = None if robots_dir is None else str(robots_dir)
    ready = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, robots, None))
    name = f"{spec.robot}, task {spec.task}, {'noise of 1 %' if spec.noise else 'exact'}"
    return TestProblem(
        name, ready.problem, ready.source.truth.theta, not spec.noise, ready.experiment
    )


EXPERIMENTS: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5", "task": "payload", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""A whole robot and a payload, noisy, each with a held-out motion."""


def check_metric_plugin(metric: Metric) -> list[Finding]:
    """Findings of a metric: one for each violated law, or a single one that it passes."""
    broken = check_metric(metric, metric_cells())
    if not broken:
        return [Finding("keeps the laws of a metric", "two experiments", True)]
    return [Finding("keeps the laws of a metric", "two experiments", False, b) for b in broken]


@cache
def metric_cells() -> tuple[MetricInput, ...]:
    """The experiments, identified by weighted least squares and scored."""
    return tuple(_cell(changes) for changes in EXPERIMENTS)


def _cell(changes: Mapping[str, Any]) -> MetricInput:
    # Held-out motions differ in kind, or a metric of prediction would see the training again.
    spec = experiment_spec({"held_out": ({"use": "ptp"},), **changes})
    prepared = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, None, None))
    estimate = identify(WLS(), prepared.problem, prepared.experiment)
    scores = score(estimate, prepared.problem, prepared.held_out, prepared.source.truth)
    return MetricInput(estimate, prepared.problem, prepared.held_out, scores)
