"""One body of an estimate made physically consistent, and what that costs."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.identification.identify import identify
from sysid_bench.spatial import body_mass_inertia, inertia_values, pseudo_inertia
from sysid_bench.types import Array, Body, Problem

GROUPS: Final = {"mass": (slice(0, 1), 1), "com": (slice(1, 4), 4), "inertia": (slice(4, 10), 10)}
"""Values of a body in SI, and how many of its parameters must be identifiable for each."""

NOTHING: Final = 1e-3
"""Squared residuals over their noise that a constraint adds without binding: rounding of the
solver; one standard deviation of a parameter adds 1."""


@dataclass(frozen=True, eq=False)
class FeasibleBody:
    """Base parameters (r,) nearest to an estimate in the metric of the data, with which one body
    has a positive mass and a feasible inertia about its centre of mass (pseudo-inertia positive
    definite). Where that constraint binds: `excess`, squared residuals over their noise that it
    adds, `cost`, what it adds to the torque error of the training data (share), and those values
    `without` it that are identifiable: mass, com (3), inertia about it (6)."""

    beta: Array
    excess: float = 0.0
    cost: float | None = None
    without: dict[str, list[float]] | None = None

    @property
    def binds(self) -> bool:
        """True where the estimate itself had no such body."""
        return self.without is not None


def feasible_body(problem: Problem, beta: Array, body: Body) -> FeasibleBody:
    """Return `beta` (r,), moved as little as the data allow where it has no feasible `body`."""
    at = [problem.parameters.index(name) for name in body.columns]
    known = np.array(parameter_verdict(problem.base))[at] == "identifiable"
    phi = problem.base.embed(beta)[at]
    if known.all() and np.linalg.eigvalsh(pseudo_inertia(phi))[0] >= 0:
        return FeasibleBody(beta)
    # Torques whose least-squares fit is beta: the constrained fit is then the nearest one to it in
    # the metric of the data, whatever method beta comes from.
    shift = beta - _lmi(replace(problem, bodies=(), signed=()))[0]
    factors = []
    for factor in problem.factors:
        R = factor.R.copy()
        R[:, -1] += R[:, :-1] @ shift[factor.columns]
        factors.append(replace(factor, R=R))
    moved = replace(problem, factors=tuple(factors), bodies=(body,), signed=())
    nearest, excess = _lmi(moved)
    if excess < NOTHING:
        return FeasibleBody(beta)
    errors = [RowErrors([problem], one).torque_error for one in (nearest, beta)]
    cost = None if None in errors else float(errors[0] - errors[1])  # type: ignore[operator]
    values = body_values(phi)
    without = {
        k: values[part].tolist() for k, (part, count) in GROUPS.items() if known[:count].all()
    }
    return FeasibleBody(nearest, excess, cost, without)


def body_values(phi: Array) -> Array:
    """Return mass, centre of mass and inertia about it (10,) of phi (10,)."""
    mass, com, inertia = body_mass_inertia(phi)
    return np.concatenate([[mass], com, inertia_values(inertia)])


def _lmi(problem: Problem) -> tuple[Array, float]:
    """Base parameters of the feasible fit, and the squares that its constraints add."""
    estimate = identify(LMI(), problem)
    if estimate.theta is None:
        raise EstimationError(estimate.reason)
    return problem.base.K @ estimate.theta, float(estimate.stats["excess"])
