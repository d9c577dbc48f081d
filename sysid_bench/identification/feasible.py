"""Quadratic fits in the set of parameters that can exist, solved by Clarabel on the R factor."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import clarabel
import numpy as np
from scipy import sparse

from sysid_bench.errors import EstimationError
from sysid_bench.identification.compressed import EXCITED, compress
from sysid_bench.identification.physical import BASIS, LENGTH, Physical, physical
from sysid_bench.identification.weights import own_sigmas, torque_rms
from sysid_bench.types import Array, Body, Estimate, Problem

TOLERANCE: Final = 1e-9
"""Relative, of Clarabel's residuals and duality gap."""

TIE: Final = 1e-9
"""Of the largest curvature of the fit: what decides where torques do not, towards the start."""

NOISE: Final = 1e-4
"""Of a joint's RMS torque: the least noise that feasible fits take it to have."""

ZERO: Final = 1e-12
"""kg, N m and the like: rounding error of a joint term or mass that is zero."""


@dataclass(frozen=True)
class Limits:
    """What a method is told a body has to keep: `margin`, the least eigenvalue of J over its trace
    (None: no pseudo-inertia at all, masses and moments alone are not negative); `mass` (kg) of each
    body; `com`, the largest coordinate (m) of a centre of mass from the body's frame."""

    margin: float | None = 1e-7
    mass: tuple[float, float] = (0.0, np.inf)
    com: float = np.inf


@dataclass(frozen=True, eq=False)
class Cones:
    """h - G x in a product of cones; `linear` of them are half-spaces, then PSD triangles."""

    G: sparse.csc_matrix
    h: Array
    linear: int
    bodies: int

    def cones(self) -> list[object]:
        flat = [clarabel.NonnegativeConeT(self.linear)] if self.linear else []
        return flat + [clarabel.PSDTriangleConeT(4)] * self.bodies


@dataclass(frozen=True, eq=False)
class Fit:
    """x (p,) that can exist, and the certificate that nothing better does."""

    x: Array
    gap: float  # primal minus dual objective, relative
    iterations: int
    exact: bool  # the constraints cost nothing: the torques are those of least squares


@lru_cache(maxsize=64)
def cones_of(parameters: tuple[str, ...], bodies: tuple[Body, ...], limits: Limits) -> Cones:
    """The constraints of a robot, built once."""
    of = physical(parameters, bodies)
    p, nb = len(parameters), len(bodies)
    rows: list[tuple[Array, Array, float]] = []  # places, coefficients, bound: coeff x <= bound
    for i in of.not_negative:
        rows.append((np.array([i]), np.array([-1.0]), 0.0))
    for at in of.places:
        rows += _body_rows(at, limits)
    G = sparse.lil_matrix((len(rows), p))
    for k, (at, coefficients, _) in enumerate(rows):
        G[k, at] = coefficients
    h = np.array([bound for *_, bound in rows])
    if limits.margin is None or nb == 0:
        return Cones(G.tocsc(), h, len(rows), 0)
    triangle = _triangle(limits.margin)
    blocks = sparse.lil_matrix((10 * nb, p))
    for b, at in enumerate(of.places):
        blocks[10 * b : 10 * b + 10, at] = -triangle
    return Cones(
        sparse.vstack([G, blocks], format="csc"), np.append(h, np.zeros(10 * nb)), len(rows), nb
    )


def _body_rows(at: Array, limits: Limits) -> list[tuple[Array, Array, float]]:
    least, most = limits.mass
    rows = []
    if limits.margin is None:
        moments = at[[4, 7, 9]]
        rows += [(moments[[k]], np.array([-1.0]), 0.0) for k in range(3)]
        rows += [(moments, np.roll([1.0, -1.0, -1.0], k), 0.0) for k in range(3)]
    if limits.margin is None or least > 0:
        rows.append((at[[0]], np.array([-1.0]), -least))
    if most < np.inf:
        rows.append((at[[0]], np.array([1.0]), most))
    if limits.com < np.inf:
        reach = limits.com / LENGTH
        rows += [
            (at[[0, k]], np.array([-reach, sign]), 0.0) for k in (1, 2, 3) for sign in (1.0, -1.0)
        ]
    return rows


def _triangle(margin: float) -> Array:
    """Entries (10, 10) of J - margin tr(J) 1 as Clarabel wants a triangle: upper, column by
    column, off the diagonal times the root of two."""
    inner = BASIS - margin * np.trace(BASIS, axis1=1, axis2=2)[:, None, None] * np.eye(4)
    return np.array(
        [inner[:, i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(4) for i in range(j + 1)]
    )


def weighted_rows(problem: Problem, of: Physical) -> tuple[Array, Array]:
    """(A (r, p), z (r,)) of min |A x - z|: the compressed rows, each divided by its noise.

    The noise is at least NOISE of the torque: below, the weights of joints would differ by more than
    a solver can tell.
    """
    sigma = np.maximum(own_sigmas(problem), NOISE * torque_rms(problem))
    R = compress(problem, (1.0 / sigma).tolist())
    return R[:-1, :-1] @ (problem.base.K * of.scale), R[:-1, -1]


def estimate_of(of: Physical, fit: Fit) -> Estimate:
    """All parameters, with the certificate of the fit."""
    stats = {
        "duality_gap": fit.gap,
        "iterations": float(fit.iterations),
        "roundness": float(of.roundness(fit.x).min(initial=0.25)),
        "least_squares": float(fit.exact),
    }
    return Estimate(theta=of.scale * fit.x, stats=stats)


def fit(
    of: Physical, limits: Limits, A: Array, z: Array, start: Array, pull: Array | None = None
) -> Fit:
    """min |A x - z|^2 / 2 + (x - start)' pull (x - start) / 2 over what can exist.

    Without a pull the fit alone decides, and `start` only where it says nothing. Raises
    EstimationError with Clarabel's status where it does not solve to TOLERANCE.
    """
    U, values, Vt = np.linalg.svd(A, full_matrices=False)
    told = values > EXCITED * values.max(initial=0.0)
    U, values, Vt = U[:, told], values[told], Vt[told]
    size = float(values.max(initial=1.0)) ** 2
    untold = TIE * (np.eye(len(start)) - Vt.T @ Vt)
    P, q = A.T @ A / size + untold, -(A.T @ z) / size - untold @ start
    if pull is not None:
        P, q = P + pull / size, q - pull @ start / size
    cones = cones_of(of.parameters, of.bodies, limits)
    found = _solved(P, q, cones.G, cones.h, cones)
    if pull is None:
        free = found.x + Vt.T @ ((U.T @ (z - A @ found.x)) / values)
        free[of.not_negative] = np.where(
            np.abs(free[of.not_negative]) < ZERO, 0.0, free[of.not_negative]
        )
        if _exists(of, limits, cones, free):
            return Fit(free, 0.0, found.iterations, True)
    return found


def nearest(of: Physical, limits: Limits, x: Array, N: Array, start: Array, metric: Array) -> Fit:
    """min (x - start)' metric (x - start) / 2 over what can exist among x + N n (p, k).

    Raises EstimationError where nothing of it can exist.
    """
    cones = cones_of(of.parameters, of.bodies, limits)
    P, q = N.T @ metric @ N, N.T @ (metric @ (x - start))
    size = float(np.trace(P)) / max(len(P), 1) or 1.0
    G = sparse.csc_matrix(cones.G @ N)
    found = _solved(P / size, q / size, G, cones.h - cones.G @ x, cones)
    return Fit(x + N @ found.x, found.gap, found.iterations, True)


def _solved(P: Array, q: Array, G: sparse.csc_matrix, h: Array, cones: Cones) -> Fit:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    upper = sparse.csc_matrix(np.triu(P))
    answer = clarabel.DefaultSolver(upper, q, G, h, cones.cones(), settings).solve()
    status = str(answer.status)
    if "PrimalInfeasible" in status:
        raise EstimationError(
            "No bodies that can exist have these parameters: Clarabel finds the constraints "
            "contradictory. Take a feasible fit instead, or wider limits."
        )
    if status != "Solved":
        raise EstimationError(
            f"Clarabel answers {status} after {answer.iterations} iterations: no fit that can "
            "exist was found to full accuracy; a prior or limits on mass would bound it."
        )
    gap = abs(answer.obj_val - answer.obj_val_dual) / max(abs(answer.obj_val), TOLERANCE)
    return Fit(np.array(answer.x), float(gap), int(answer.iterations), False)


def _exists(of: Physical, limits: Limits, cones: Cones, x: Array) -> bool:
    """Whether x keeps the half-spaces, and half of the margin: rounding has moved it."""
    if not (cones.h - cones.G @ x)[: cones.linear].min(initial=0.0) >= -ZERO:
        return False
    if limits.margin is None or not of.bodies:
        return True
    J = of.pseudo_inertias(x)
    smallest = np.linalg.eigvalsh(J)[:, 0]
    return bool((smallest >= 0.5 * limits.margin * np.trace(J, axis1=1, axis2=2)).all())
