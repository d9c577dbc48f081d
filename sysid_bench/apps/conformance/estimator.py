"""Conformance kit of estimators.

The laws: exact data give the true parameters; the result is deterministic, equivariant under
changes of unit and invariant to the order of the joints; the input stays unchanged; a failure has
a reason; and the estimate depends on the data, not only on the prior.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import (
    UNCHANGED,
    Finding,
    data_hash,
    failed_checks,
    finding_of_error,
    findings_of,
)
from sysid_bench.apps.conformance.scaled_problem import (
    first_samples,
    rows_from_end,
    scaled_prior,
    scaled_problem,
)
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.least_squares import stacked_factor
from sysid_bench.types import Array, Estimate, Experiment, Problem

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


Law = Callable[[Any, TestProblem, Estimate], str | None]
"""(estimator, case, its estimate) -> description of the violation; None where the law holds or does
not apply."""


def check(estimator: Any, cases: Sequence[TestProblem]) -> list[Finding]:
    """Findings of all laws on all cases; an exception of the estimator violates the law that met
    it."""
    findings, reasons = [], dict[str, None]()
    answered = False
    for case in cases:
        before = data_hash((case.problem, case.experiment))
        try:
            first = _estimate(estimator, case)
        except Exception as error:
            findings.append(finding_of_error(error, "returns an estimate", case.name))
            continue
        answered = answered or first.status == "ok"
        reasons[first.reason] = None
        findings += findings_of(LAWS, case.name, estimator, case, first)
        if data_hash((case.problem, case.experiment)) != before:
            message = "it changed an array of the problem"
            findings.append(Finding(UNCHANGED, case.name, False, message))
    if not answered:
        given = "; ".join(filter(None, reasons))
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


LAWS: Final[dict[str, Law]] = {
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
