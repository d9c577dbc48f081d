"""Simulatable parameters: physically consistent bodies, non-negative friction and rotor inertia.

Data determine base parameters; a simulation needs all. Among all theta with K theta = beta the one
nearest to a centre is used, in the log-det divergence of the pseudo-inertias (Lee, Wensing, Park
2020), which is infinite at the boundary.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import NOT_NEGATIVE, feasible_set_of
from sysid_bench.spatial import pseudo_inertia
from sysid_bench.types import Array, Problem

WEIGHTS: Final = (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
"""Homotopy: weights of the divergence against the relative squared misfit of beta. Each solution
starts the next, and the last changes beta by less than any noise."""

REACHED: Final = 1e-6
"""Share of a distance to beta that a move onto it may leave."""

ROUNDING: Final = 1e-12
"""Relative rounding of base parameters."""

FIRST_CENTRE: Final = (1.0, 0.1)
"""Mass (kg) and radius of gyration (m) of each body without a prior: the centre matters along
unobservable directions alone."""

SMALLEST: Final = 1e-4
"""Least share of the first centre in a centre: massless bodies have no interior."""


BORDER: Final = 1e-6
"""Least Cholesky diagonal of a pseudo-inertia with unit diagonal: its square is the rounding error
of the smallest eigenvalue."""


@dataclass(frozen=True, eq=False)
class SimulatableSet:
    """Set of simulatable theta (p,), with a centre (p,) in its interior."""

    problem: Problem
    centre: Array

    @cached_property
    def bodies(self) -> Array:
        """Indices (nb, 10) of the parameters of each body."""
        return feasible_set_of(self.problem).indices

    @cached_property
    def nonnegative(self) -> Array:
        """Indices (k,) of the non-negative parameters."""
        names = self.problem.parameters
        return np.array([i for i, n in enumerate(names) if n.endswith(NOT_NEGATIVE)], dtype=int)

    @cached_property
    def scale(self) -> Array:
        """Size (p,) of each parameter at the centre, for the terms of either sign."""
        return np.asarray(np.maximum(np.abs(self.centre), 1.0))

    @cached_property
    def _inverse_centre(self) -> Array:
        """Inverse pseudo-inertias (nb, 4, 4) of the centre."""
        return np.linalg.inv(pseudo_inertia(self.centre[self.bodies]))

    def divergence(self, theta: Array) -> float:
        """Log-det divergence of theta from the centre; infinite outside the set."""
        ratio = theta[self.nonnegative] / self.centre[self.nonnegative]
        J = pseudo_inertia(theta[self.bodies])
        if (ratio <= 0).any() or not _positive_definite(J):
            return np.inf
        product = self._inverse_centre @ J
        bodies = np.trace(product, axis1=1, axis2=2) - np.linalg.slogdet(product)[1] - 4
        rest = (theta - self.centre)[self._others] / self.scale[self._others]
        return float(bodies.sum() + (ratio - np.log(ratio) - 1).sum() + 0.5 * rest @ rest)

    def newton_terms(self, theta: Array) -> tuple[Array, Array]:
        """Gradient (p,) and Hessian (p, p) of the divergence."""
        p = len(theta)
        gradient, hessian = np.zeros(p), np.zeros((p, p))
        inverse = np.linalg.inv(pseudo_inertia(theta[self.bodies]))
        turned = np.einsum("bij,kjl->bkil", inverse, _DIRECTIONS)
        gradient[self.bodies] = np.einsum(
            "bij,kji->bk", self._inverse_centre - inverse, _DIRECTIONS
        )
        blocks = np.einsum("bkij,blji->bkl", turned, turned)
        hessian[self.bodies[:, :, None], self.bodies[:, None, :]] = blocks
        x, x0 = theta[self.nonnegative], self.centre[self.nonnegative]
        gradient[self.nonnegative] = 1 / x0 - 1 / x
        hessian[self.nonnegative, self.nonnegative] = 1 / x**2
        rest = self._others
        gradient[rest] = (theta - self.centre)[rest] / self.scale[rest] ** 2
        hessian[rest, rest] = 1 / self.scale[rest] ** 2
        return gradient, hessian

    @cached_property
    def _others(self) -> Array:
        taken = np.concatenate([self.bodies.ravel(), self.nonnegative])
        return np.setdiff1d(np.arange(len(self.problem.parameters)), taken)

    def nearest(self, beta: Array, R: Array) -> Array:
        """Return theta (p,) in the set with K theta = beta; where none exists, with K theta nearest
        to beta in the metric |R (K theta - beta)|, R (r, r). Raises EstimationError for a beta that
        is not finite."""
        K, size = self.problem.base.K, float(np.linalg.norm(R @ beta))
        if not np.isfinite(size):
            raise EstimationError("The base parameters are not finite and cannot be simulated.")
        if size == 0.0:
            return self.centre
        # Relative residuals: the weights of the divergence do not depend on units or samples.
        A, b = R @ K / size, R @ beta / size
        theta = self.centre
        for weight in WEIGHTS:
            try:
                theta = self._newton(theta, A, b, weight)
            except EstimationError:
                if weight == WEIGHTS[0]:
                    raise
                break  # the limit of rounding
        return self.with_base(theta, beta)

    def with_base(self, theta: Array, beta: Array) -> Array:
        """Return theta moved onto K theta = beta along the shortest path in the Hessian metric;
        theta itself where that leaves the set, or where rounding keeps it from beta."""
        gap = beta - self.problem.base.K @ theta
        moved = theta + self.pseudo_inverse(theta) @ gap
        # Next to the border the Hessian is so large that its solution can be all rounding.
        rest = np.linalg.norm(beta - self.problem.base.K @ moved)
        close = rest <= REACHED * np.linalg.norm(gap) + ROUNDING * np.linalg.norm(beta)
        return moved if close and np.isfinite(self.divergence(moved)) else theta

    def pseudo_inverse(self, theta: Array) -> Array:
        """L (p, r) with K L = 1, the shortest in the Hessian metric at theta."""
        K = self.problem.base.K
        spread = _solve(self.newton_terms(theta)[1], K.T)
        return np.linalg.solve((K @ spread).T, spread.T).T

    def step_limit(self, theta: Array, direction: Array) -> float:
        """Step length along a direction (p,) that stays in the set: half the Dikin ellipsoid, which
        the Hessian of the divergence spans around theta (Dikin 1967)."""
        size = float(np.sqrt(direction @ self.newton_terms(theta)[1] @ direction))
        return 0.5 / size if size > 0 else np.inf

    def _newton(self, theta: Array, A: Array, b: Array, weight: float) -> Array:
        """Damped Newton on |A theta - b|^2 / 2 + weight * divergence."""

        def cost(x: Array) -> float:
            misfit = A @ x - b
            return 0.5 * float(misfit @ misfit) + weight * self.divergence(x)

        now, square = cost(theta), A.T @ A
        for _ in range(30):
            gradient, hessian = self.newton_terms(theta)
            gradient = A.T @ (A @ theta - b) + weight * gradient
            step = -_solve(square + weight * hessian, gradient)
            expected = -float(gradient @ step)
            if expected <= 1e-3 * weight:  # small against the curvature of the divergence
                break
            length, there = 1.0, cost(theta + step)
            # Armijo's rule; the cost is infinite outside the set, so that steps end inside.
            while length > 1e-6 and there > now - 0.1 * length * expected:
                length *= 0.5
                there = cost(theta + length * step)
            if length <= 1e-6:
                break
            theta, now = theta + length * step, there
        return theta


@dataclass(frozen=True, eq=False)
class FreeSet(SimulatableSet):
    """All theta (p,): for models that run with any base parameters, of no bodies as well."""

    def with_base(self, theta: Array, beta: Array) -> Array:
        """Return theta moved onto K theta = beta along the pivots."""
        moved = theta.copy()
        # K is the identity on its pivots: they take up the whole difference.
        moved[self.problem.base.pivots] += beta - self.problem.base.K @ theta
        return moved


def simulatable_set(problem: Problem) -> SimulatableSet:
    """Simulatable set of a problem's parameters, centred at its prior if it has one."""
    mass, radius = FIRST_CENTRE
    # Second moments m r^2 along every axis: I = 2 m r^2 about each.
    moment = 2 * mass * radius**2
    body = np.array([mass, 0, 0, 0, moment, 0, 0, moment, 0, moment])
    centre = np.array([float(name.endswith(NOT_NEGATIVE)) for name in problem.parameters])
    first = SimulatableSet(problem, centre)
    centre[first.bodies] = body
    if problem.prior is None:
        return first
    # The prior, mixed with the first centre where it lies on or beyond the boundary
    theta = problem.prior.theta.copy()
    for indices in first.bodies:
        body, centre = theta[indices], first.centre[indices]
        share = SMALLEST
        while not _positive_definite(pseudo_inertia(body)[None]):
            body, share = body + share * centre, 10 * share
        theta[indices] = body
    indices = first.nonnegative
    theta[indices] = np.where(theta[indices] > 0, theta[indices], SMALLEST * first.centre[indices])
    return SimulatableSet(problem, theta)


def _positive_definite(J: Array) -> bool:
    """Return whether pseudo-inertias (nb, 4, 4) are positive definite beyond rounding."""
    diagonal = np.diagonal(J, axis1=1, axis2=2)
    if not (diagonal > 0).all():
        return False
    # With a unit diagonal the border does not depend on the size of a body.
    scale = 1.0 / np.sqrt(diagonal)
    try:
        factor = np.linalg.cholesky(scale[:, :, None] * J * scale[:, None, :])
    except np.linalg.LinAlgError:
        return False
    return bool((np.diagonal(factor, axis1=1, axis2=2) > BORDER).all())


def _solve(H: Array, b: Array) -> Array:
    """H^-1 b for a badly scaled positive definite H; a small multiple of the diagonal is added,
    growing while rounding leaves H indefinite."""
    scale = 1.0 / np.sqrt(np.diag(H))
    even = scale[:, None] * H * scale
    for share in (0.0, 1e-14, 1e-12, 1e-10, 1e-8):
        try:
            factor = cho_factor(even + share * np.eye(len(even)))
        except np.linalg.LinAlgError:
            continue
        return (scale * cho_solve(factor, (scale * b.T).T).T).T
    raise EstimationError(
        "No physically consistent bodies were found for these torques: the problem is too "
        "badly scaled."
    )


_DIRECTIONS = pseudo_inertia(np.eye(10))
