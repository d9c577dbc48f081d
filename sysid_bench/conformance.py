"""What an estimator owes its callers: laws that any method is run through on its own.

A world is a problem with its answer. Laws ask for the truth where data are exact, that the input is
left alone, for the same answer twice, in other units and with joints in another order, for a reason
where there is none, and for more than the values that the method was given to start from.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.errors import reason_of
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.normal_qr import stacked_factor
from sysid_bench.types import Array, Estimate, Experiment, Factor, Prior, Problem, RowBlock

EXACT: Final = 1e-8
"""|beta - beta*| / |beta*| of a method that claims consistency, on exact data."""

SAME: Final = 1e-5
"""Of the torques: what two answers may differ by that ought to be one."""

STARTED: Final = 1e-9
"""Relative; an answer nearer than this to a prior that is wrong, or to zero, is no answer."""


@dataclass(frozen=True, eq=False)
class TestProblem:
    """A problem whose answer is known. `exact`: its data are; `experiment` where there is one."""

    name: str
    problem: Problem
    theta: Array  # (p,) that the data were made with
    exact: bool
    experiment: Experiment | None = None


@dataclass(frozen=True)
class Finding:
    """One law on one world: kept, or what was seen instead."""

    law: str
    world: str
    kept: bool
    said: str = ""


Law = Callable[[Any, TestProblem, Estimate], str | None]
"""(estimator, world, its answer) -> what was seen instead, in words; None where the law is kept or
does not apply."""


def check(estimator: Any, worlds: Sequence[TestProblem]) -> list[Finding]:
    """Every law on every world; a method's own exception breaks the law that met it."""
    findings, answered, reasons = [], False, dict[str, None]()
    for world in worlds:
        before = fingerprint((world.problem, world.experiment))
        try:
            first = _answer(estimator, world)
        except Exception as error:
            name = "leaves its input alone" if "read-only" in str(error) else "answers"
            findings.append(Finding(name, world.name, False, f"it raised {reason_of(error)}"))
            continue
        answered = answered or first.status == "ok"
        reasons[first.reason] = None
        for name, law in LAWS.items():
            try:
                said = law(estimator, world, first)
            except Exception as error:
                said = f"it raised {reason_of(error)}"
            findings.append(Finding(name, world.name, said is None, said or ""))
        if fingerprint((world.problem, world.experiment)) != before:
            said = "it changed what it was given"
            findings.append(Finding("leaves its input alone", world.name, False, said))
    if not answered:
        told = "; ".join(filter(None, reasons))
        said = "it answered none of them" + (f": {told}" if told else "")
        findings.append(Finding("answers", "all worlds", False, said))
    return findings


def failed_checks(findings: Sequence[Finding]) -> list[str]:
    """The broken laws, a line each."""
    return [f"{f.law} ({f.world}): {f.said}" for f in findings if not f.kept]


def _answer(estimator: Any, world: TestProblem) -> Estimate:
    return identify(estimator, world.problem, world.experiment)


def _recovers_exact_parameters(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """Exact data give the truth; a method that is biased by design says so in `bias`."""
    if not world.exact or _bias(estimator):
        return None
    if first.beta is None or first.status != "ok":
        return None
    truth = world.problem.base.K @ world.theta
    error = _relative(first.beta - truth, truth)
    if error <= EXACT:
        return None
    return (
        f"exact data give beta with an error of {error:.1e}; {EXACT:.0e} is allowed. A method that "
        "is biased by design says how in an attribute 'bias'"
    )


def _is_deterministic(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """The same problem, the same numbers, to the last digit."""
    second = _answer(estimator, world)
    if first.status != second.status:
        return f"it answers {first.status!r} and then {second.status!r}"
    for name in ("beta", "theta", "covariance"):
        if not np.array_equal(_of(first, name), _of(second, name)):
            return f"{name} differs from one call to the next"
    return None


def _is_invariant_to_torque_units(
    estimator: Any, world: TestProblem, first: Estimate
) -> str | None:
    """Torques and regressor in another unit: the same parameters."""
    factor = 4.0
    return _same(
        estimator, world, first, permuted_rows(world.problem, rows=factor, values=factor), 1.0
    )


def _is_invariant_to_mass_units(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """Torques, prior and parameters in another unit: the same numbers in that unit."""
    factor = 2.0
    problem = permuted_rows(world.problem, values=factor)
    if problem.prior is not None:
        problem = replace(
            problem, prior=Prior(factor * problem.prior.theta, factor * problem.prior.std)
        )
    return _same(estimator, world, first, problem, factor)


def _is_invariant_to_row_order(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """Rows from last to first: the same parameters."""
    return _same(estimator, world, first, permuted_parameters(world.problem), 1.0)


def _gives_a_reason_on_failure(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """One sample tells next to nothing: an answer is finite, a refusal has its reason."""
    if not hasattr(estimator, "solve"):
        return None
    for estimate in (first, identify(estimator, subset_of_rows(world.problem, 1))):
        if estimate.status != "ok" and len(estimate.reason.split()) < 3:
            return f"its status is {estimate.status!r} and its reason {estimate.reason!r}"
    return None


def _requires_its_inputs(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """One sample and no prior tell fewer base parameters than there are: who answers all of them
    has taken the rest from somewhere, and says so (`bias`, or whole bodies: `theta`)."""
    if not hasattr(estimator, "solve"):
        return None
    problem = replace(subset_of_rows(world.problem, 1), prior=None)
    if len(problem.rows) >= problem.base.rank:
        return None
    estimate = identify(estimator, problem)
    if estimate.status != "ok" or _bias(estimator) or estimate.theta is not None:
        return None
    return "one sample and no prior give it all base parameters, and it does not say how"


def _uses_the_data(estimator: Any, world: TestProblem, first: Estimate) -> str | None:
    """An answer that is the prior, or nothing, is none; the prior here is wrong."""
    estimate = first
    if estimate.status != "ok" or estimate.beta is None:
        return None
    problem = world.problem
    if _relative(estimate.beta, problem.base.K @ world.theta) <= STARTED:
        return "it answers zero"
    if problem.prior is None:
        return None
    start = problem.base.K @ problem.prior.theta
    if _relative(estimate.beta - start, start) <= STARTED:
        return "it answers the prior: a fit that only returned its start is a failure"
    return None


LAWS: Final[dict[str, Law]] = {
    "tells the truth": _recovers_exact_parameters,
    "answers the same twice": _is_deterministic,
    "does not care for units of torque": _is_invariant_to_torque_units,
    "does not care for units of mass": _is_invariant_to_mass_units,
    "does not care for the order of joints": _is_invariant_to_row_order,
    "says why it cannot": _gives_a_reason_on_failure,
    "refuses what is not told": _requires_its_inputs,
    "does more than start": _uses_the_data,
}


def _same(
    estimator: Any, world: TestProblem, one: Estimate, other: Problem, factor: float
) -> str | None:
    """Whether another form of the problem has the same answer, `factor` times."""
    if not hasattr(estimator, "solve"):
        return None
    two = identify(estimator, other)
    if one.status != two.status:
        return f"it answers {one.status!r} in one form and {two.status!r} in the other"
    if one.beta is None or two.beta is None or one.status != "ok":
        return None
    R = stacked_factor(world.problem)[:-1, :-1]
    error = _relative(R @ (two.beta / factor - one.beta), R @ one.beta)
    return None if error <= SAME else f"the torques of the two answers differ by {error:.1e}"


def permuted_rows(problem: Problem, rows: float = 1.0, values: float = 1.0) -> Problem:
    """The problem with its regressor and its torques multiplied."""
    factors = tuple(
        replace(f, R=f.R * np.append(np.full(len(f.columns), rows), values))
        for f in problem.factors
    )
    blocks = partial(_turned, problem.blocks, rows, values)
    return _fresh(problem, factors=factors, blocks=blocks)


def permuted_parameters(problem: Problem) -> Problem:
    """The problem with its rows from last to first."""
    return _fresh(
        problem,
        rows=problem.rows[::-1],
        factors=problem.factors[::-1],
        kinds=problem.kinds[::-1],
        blocks=partial(_reversed, problem.blocks),
    )


def subset_of_rows(problem: Problem, samples: int) -> Problem:
    """The problem of the first samples alone."""
    Y, b = next(iter(problem.blocks()))
    Y, b = Y[:samples].copy(), b[:samples].copy()
    factors = []
    for i, factor in enumerate(problem.factors):
        stack = np.column_stack([Y[:, i, factor.columns], b[:, i]])
        R = np.asarray(np.linalg.qr(stack, mode="r"))
        factors.append(Factor(factor.row, factor.columns, R, len(b)))
    blocks = partial(_once, Y, b)
    return _fresh(problem, factors=tuple(factors), blocks=blocks, samples=len(b))


def _fresh(problem: Problem, **changes: Any) -> Problem:
    # `replace` makes a new object, so that rows that were stacked before are not kept.
    return replace(problem, **changes)


def _turned(
    blocks: Callable[[], Iterator[RowBlock]], rows: float, values: float
) -> Iterator[RowBlock]:
    for Y, b in blocks():
        yield rows * Y, values * b


def _reversed(blocks: Callable[[], Iterator[RowBlock]]) -> Iterator[RowBlock]:
    for Y, b in blocks():
        yield Y[:, ::-1], b[:, ::-1]


def _once(Y: Array, b: Array) -> Iterator[RowBlock]:
    yield Y, b


def _bias(estimator: Any) -> str:
    return str(getattr(estimator, "bias", ""))


def _relative(difference: Array, reference: Array) -> float:
    return float(np.linalg.norm(difference)) / max(float(np.linalg.norm(reference)), 1e-300)


def _of(estimate: Estimate, name: str) -> Array:
    value = getattr(estimate, name)
    return np.zeros(0) if value is None else value


def fingerprint(value: Any) -> str:
    """A hash of every array that a noun holds."""
    total = hashlib.sha256()
    for array in _arrays(value):
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def _arrays(value: Any) -> Iterator[Array]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, partial):
        yield from _arrays(value.args)
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _arrays(part)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _arrays(getattr(value, field.name))


def assert_conforms(estimator: Any, worlds: Sequence[TestProblem]) -> None:
    """For tests: raises AssertionError that lists every broken law."""
    lines = failed_checks(check(estimator, worlds))
    if lines:
        raise AssertionError(f"{estimator!r} breaks {len(lines)} laws:\n" + "\n".join(lines))
