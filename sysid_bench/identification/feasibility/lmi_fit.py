"""Feasible fits under linear matrix inequalities (LMIs), and the constraints that bind.

A quadratic objective on the R factor over the feasible set, solved by Clarabel."""

import itertools
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import clarabel
import numpy as np
import scipy
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import (
    BASIS,
    LENGTH,
    WEAK,
    FeasibleSet,
    feasible_set_of,
    nullspace,
    scaled_coordinates,
)
from sysid_bench.types import Array, BaseMap, Estimate, Problem

TOLERANCE: Final = 1e-7
"""Clarabel's tolerance of the duality gap, a sum of squares with unit noise variance."""

ATTEMPTS: Final = ((0.99, 1.0), (0.95, 1.0), (0.9, 1.0), (0.99, 1e-3), (0.99, 1e-6))
"""Largest step fraction and scale of the objective: Clarabel's defaults, smaller steps where
rounding stops it, smaller objectives where data far outside of the feasible set exhaust it."""

FEASIBLE: Final = (1e-9, 1e-8)
"""Tolerance of the constraints, and the one accepted where rounding allows no less."""

LEAST: Final = 3e-8
"""Least eigenvalue of J (kg, lengths in LENGTH), above the tolerance of the constraints."""

SOLVED: Final = ("Solved", "AlmostSolved")
"""Statuses of Clarabel with an answer."""

ACCEPTED: Final = 1e-4
"""Duality gap, absolute or relative, accepted where rounding allows no less."""


@dataclass(frozen=True)
class Limits:
    """Constraints of each body: `margin`, least eigenvalue of J over its trace (None: no LMI, only
    non-negative masses and moments with the triangle inequality); `mass` (kg); `com`, the largest
    coordinate (m) of the centre of mass in the body frame."""

    margin: float | None = 1e-7
    mass: tuple[float, float] = (0.0, np.inf)
    com: float = np.inf


@dataclass(frozen=True, eq=False)
class _Cones:
    """Constraints h - G x in a product of cones: `linear` half-spaces, then PSD triangles."""

    G: "scipy.sparse.csc_matrix"
    h: Array
    linear: int
    bodies: int

    def cones(self) -> list[object]:
        flat = [clarabel.NonnegativeConeT(self.linear)] if self.linear else []
        return flat + [clarabel.PSDTriangleConeT(4)] * self.bodies


@dataclass(frozen=True, eq=False)
class Fit:
    """Feasible x (p,) with its optimality certificate."""

    x: Array
    gap: float  # primal minus dual objective, where noise has the variance one
    iterations: int
    excess: float  # squares that the constraints add to those of least squares


@lru_cache(maxsize=64)
def _cones_of(feasible: FeasibleSet, limits: Limits) -> _Cones:
    """Constraints of a robot, cached."""
    p, nb = len(feasible.parameters), len(feasible.bodies)
    rows: list[_Bound] = [(np.array([i]), np.array([-1.0]), 0.0) for i in feasible.nonnegative]
    for at in feasible.indices:
        rows += _body_rows(at, limits)
    G = scipy.sparse.lil_matrix((len(rows), p))
    for k, (at, coefficients, _) in enumerate(rows):
        G[k, at] = coefficients
    h = np.array([bound for *_, bound in rows])
    if limits.margin is None or nb == 0:
        return _Cones(G.tocsc(), h, len(rows), 0)
    # Clarabel's triangle (10, 10) of J - margin tr(J) 1 for each unit x: the upper triangle by
    # columns, off-diagonal entries times sqrt(2).
    inner = BASIS - limits.margin * np.trace(BASIS, axis1=1, axis2=2)[:, None, None] * np.eye(4)
    triangle = np.stack([_entries(one) for one in inner], axis=1)
    blocks = scipy.sparse.lil_matrix((10 * nb, p))
    for b, at in enumerate(feasible.indices):
        blocks[10 * b : 10 * b + 10, at] = -triangle
    stacked = scipy.sparse.vstack([G, blocks], format="csc")
    # J >= LEAST 1 rather than J >= 0: the solver's tolerance then stays on the feasible side.
    least = np.tile(-LEAST * _entries(np.eye(4)), nb)
    return _Cones(stacked, np.append(h, least), len(rows), nb)


_Bound = tuple[Array, Array, float]
"""Indices (k,) in x, coefficients (k,) and bound of an inequality: coefficients . x <= bound."""


def _body_rows(at: Array, limits: Limits) -> list[_Bound]:
    """Bounds of a body with the parameters x[at]; with an LMI, J > 0 implies those of moments."""
    rows: list[_Bound] = []
    (least, most), moments, mass = limits.mass, at[[4, 7, 9]], at[[0]]
    if limits.margin is None:
        # Non-negative Ixx, Iyy, Izz, and the triangle inequality Ixx <= Iyy + Izz of each.
        rows += [(moments[[k]], np.array([-1.0]), 0.0) for k in range(3)]
        rows += [(moments, np.roll([1.0, -1.0, -1.0], k), 0.0) for k in range(3)]
    if limits.margin is None or least > 0:
        rows.append((mass, np.array([-1.0]), -least))
    if most < np.inf:
        rows.append((mass, np.array([1.0]), most))
    if limits.com < np.inf:
        # |h_k| <= reach m: linear in x, where a bound on the centre of mass h / m is not.
        reach, signs = limits.com / LENGTH, itertools.product((1, 2, 3), (1.0, -1.0))
        rows += [(at[[0, k]], np.array([-reach, sign]), 0.0) for k, sign in signs]
    return rows


def _entries(M: Array) -> Array:
    """Clarabel's triangle (10,) of a symmetric matrix (4, 4)."""
    return np.array(
        [M[i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(4) for i in range(j + 1)]
    )


def fit(
    feasible: FeasibleSet, problem: Problem, limits: Limits, start: Array, pull: Array | None = None
) -> Fit:
    """Return the weighted least-squares fit, plus (x - start)' pull (x - start) / 2, over the
    feasible set.

    Without `pull` the start (p,) matters along unexcited directions alone. Raises EstimationError
    with Clarabel's status where it does not solve to TOLERANCE.
    """
    at = scaled_coordinates(feasible, problem, start)
    p, r = len(start), at.rank
    # u has unit weight by its definition. Torques do not depend on n, which needs a little weight
    # of its own: without it the program has no single answer.
    P, q = np.diag(np.repeat([1.0, WEAK], [r, p - r])), np.zeros(p)
    if pull is not None:
        P, q = P + at.T.T @ pull @ at.T, at.T.T @ (pull @ (at.origin - start))
    y, gap, iterations = _solved(feasible, limits, at.origin, at.T, P, q)
    x = _existing(feasible, limits, at.origin + at.T @ y)
    return Fit(x, gap, iterations, float(y[:r] @ y[:r]))


def nearest(feasible: FeasibleSet, base: BaseMap, beta: Array, start: Array, metric: Array) -> Fit:
    """Minimise (x - start)' metric (x - start) / 2 over feasible x with the base parameters beta.

    Raises EstimationError where no feasible x has them."""
    N = nullspace(feasible, base)
    x = start.copy()
    free = np.setdiff1d(np.arange(len(x)), base.pivots)
    # The pivots compensate the non-pivot parameters of the start, so that K theta = beta.
    x[base.pivots] = beta / feasible.scale[base.pivots] + N[base.pivots] @ start[free]
    P, q = N.T @ metric @ N, N.T @ (metric @ (x - start))
    n, gap, iterations = _solved(feasible, Limits(), x, N, P, q)
    return Fit(_existing(feasible, Limits(), x + N @ n), gap, iterations, 0.0)


def estimate_of(feasible: FeasibleSet, fit: Fit) -> Estimate:
    """Estimate of all parameters with the certificate of the fit."""
    stats = {
        "duality_gap": fit.gap,
        "iterations": float(fit.iterations),
        "roundness": feasible.roundness(fit.x),
        "excess": fit.excess,
    }
    return Estimate(theta=feasible.scale * fit.x, stats=stats)


def _solved(
    feasible: FeasibleSet, limits: Limits, origin: Array, T: Array, P: Array, q: Array
) -> tuple[Array, float, int]:
    """(y, duality gap, iterations) of min y'Py / 2 + q'y with origin + T y feasible.

    Solved for the offset d from the unconstrained minimum y0, y = y0 + d / sqrt(diag(P)): the
    objective is then the cost of the constraints alone, and so is its accuracy.
    """
    # The cone h - G (origin + T y): the constraints of a robot in the coordinates of its data.
    cones = _cones_of(feasible, limits)
    size = 1 / np.sqrt(np.maximum(np.diag(P), 1.0))
    # Unit diagonal: coordinates of very different weight would exhaust the solver's accuracy.
    P = P * size * size[:, None]
    free = -size * cho_solve(cho_factor(P), size * q) if q.any() else np.zeros(len(q))
    origin, T = origin + T @ free, T * size
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = TOLERANCE
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = ACCEPTED
    settings.tol_feas, settings.reduced_tol_feas = FEASIBLE
    for step, scale in ATTEMPTS:
        settings.max_step_fraction = step
        answer = clarabel.DefaultSolver(
            scipy.sparse.csc_matrix(scale * np.triu(P)),
            np.zeros(len(q)),
            scipy.sparse.csc_matrix(cones.G @ T),
            cones.h - cones.G @ origin,
            cones.cones(),
            settings,
        ).solve()
        status = str(answer.status)
        if status in SOLVED:
            break
    if "PrimalInfeasible" in status:
        raise EstimationError(
            "No physically consistent bodies have these parameters: Clarabel finds the constraints "
            "infeasible. Use a feasible fit instead, or wider limits."
        )
    if status not in SOLVED:
        raise EstimationError(
            f"Clarabel returned {status} after {answer.iterations} iterations: no feasible fit was "
            "found to full accuracy; a prior or limits on mass would bound it."
        )
    gap = abs(answer.obj_val - answer.obj_val_dual) / scale
    return free + size * np.array(answer.x), gap, int(answer.iterations)


def _existing(feasible: FeasibleSet, limits: Limits, x: Array) -> Array:
    """x (p,) with joint terms that are negative by rounding set to zero; raises EstimationError
    where a pseudo-inertia has a negative eigenvalue."""
    out = x.copy()
    out[feasible.nonnegative] = np.maximum(x[feasible.nonnegative], 0.0)
    if limits.margin is not None and feasible.bodies:
        smallest = float(np.linalg.eigvalsh(feasible.pseudo_inertia(out))[:, 0].min())
        if not smallest >= 0:
            raise EstimationError(
                f"Clarabel's solution has a pseudo-inertia with the eigenvalue {smallest:.1e}: it "
                "is not physically consistent; use a larger margin."
            )
    return out


NEARLY_SINGULAR: Final = 1e-6
"""Smallest eigenvalue of a pseudo-inertia over its trace below which its constraint binds."""

NEARLY_ZERO: Final = 1e-6
"""Joint term over the largest of the same kind below which its sign constraint binds."""


def binding_constraints(problem: Problem, theta: Array) -> tuple[str, ...]:
    """Return the names of the bodies and joint terms whose constraints bind at theta (p,), the
    estimate of `lmi`."""
    feasible = feasible_set_of(problem)
    singular = feasible.relative_margins(theta / feasible.scale) < NEARLY_SINGULAR
    bodies = [b.name for b, binds in zip(problem.bodies, singular, strict=True) if binds]
    signed = feasible.nonnegative
    # A joint term binds where it is zero beside the largest of its kind.
    kinds = np.array([problem.parameters[i].rpartition(".")[2] for i in signed])
    values = np.abs(theta[signed])
    largest = np.array([values[kinds == kind].max() for kind in kinds])
    at_zero = values <= NEARLY_ZERO * largest
    return (*bodies, *(problem.parameters[i] for i in signed[at_zero]))


def problem_without(problem: Problem, *constraints: str) -> Problem:
    """Return the problem without the constraints on these bodies and joint terms."""
    kept = tuple(body for body in problem.bodies if body.name not in constraints)
    signed = [problem.parameters[i] for i in feasible_set_of(problem).nonnegative]
    signed = [name for name in signed if name not in constraints]
    return replace(problem, bodies=kept, signed=tuple(signed))
