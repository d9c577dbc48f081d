"""Parameters that can be simulated: bodies that exist, friction and rotors that are not negative.

Base parameters say what a motion tells; a simulation needs every body. Of all theta with
K theta = beta the one nearest to a centre is taken, in the log-determinant divergence of the
pseudo-inertias (Lee, Wensing, Park 2020), which is infinite where a body cannot exist.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.spatial.inertia import pseudo_inertia
from sysid_bench.types import Array, Prior, Problem

POSITIVE: Final = (".fv", ".fc", ".Ia")
"""Joint terms that cannot be negative."""

WEIGHTS: Final = (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
"""Weights of the divergence against the relative squared misfit of beta: each start is near the
next end, and the last moves beta by less than any noise."""

FIRST_CENTRE: Final = (1.0, 0.1)
"""Mass (kg) and radius of gyration (m) of every body where no prior says better: where the centre
lies matters only along what no torque tells."""

SMALLEST: Final = 1e-4
"""Share of the first centre that every body of a centre has at least: frames weigh nothing, and
nothing has no inside."""


BORDER: Final = 1e-6
"""How near the border bodies may come, in units of a pseudo-inertia with unit diagonal: its square
is what rounding leaves of the smallest eigenvalue."""


@dataclass(frozen=True, eq=False)
class SimulatableSet:
    """The set of theta that can be simulated, with a centre (p,) inside of it."""

    problem: Problem
    centre: Array

    @cached_property
    def bodies(self) -> Array:
        """Places (nb, 10) of the bodies' parameters."""
        places = {name: i for i, name in enumerate(self.problem.parameters)}
        found = [[places[column] for column in body.columns] for body in self.problem.bodies]
        return np.array(found, dtype=int).reshape(-1, 10)

    @cached_property
    def positive(self) -> Array:
        """Places (k,) of the parameters that are not negative."""
        names = self.problem.parameters
        return np.array([i for i, n in enumerate(names) if n.endswith(POSITIVE)], dtype=int)

    @cached_property
    def scale(self) -> Array:
        """The size (p,) of each parameter at the centre, for the terms of any sign."""
        return np.maximum(np.abs(self.centre), 1.0)

    @cached_property
    def centres(self) -> Array:
        """Inverse pseudo-inertias (nb, 4, 4) of the centre."""
        return np.linalg.inv(pseudo_inertia(self.centre[self.bodies]))

    def divergence(self, theta: Array) -> float:
        """How far theta is from the centre; infinite where it cannot be simulated."""
        ratio = theta[self.positive] / self.centre[self.positive]
        J = pseudo_inertia(theta[self.bodies])
        if (ratio <= 0).any() or not _positive_definite(J):
            return np.inf
        product = self.centres @ J
        bodies = np.trace(product, axis1=1, axis2=2) - np.linalg.slogdet(product)[1] - 4
        rest = (theta - self.centre)[self._others] / self.scale[self._others]
        return float(bodies.sum() + (ratio - np.log(ratio) - 1).sum() + 0.5 * rest @ rest)

    def gradients(self, theta: Array) -> tuple[Array, Array]:
        """Gradient (p,) and Hessian (p, p) of the divergence."""
        p = len(theta)
        gradient, hessian = np.zeros(p), np.zeros((p, p))
        inverse = np.linalg.inv(pseudo_inertia(theta[self.bodies]))
        turned = np.einsum("bij,kjl->bkil", inverse, _DIRECTIONS)
        gradient[self.bodies] = np.einsum("bij,kji->bk", self.centres - inverse, _DIRECTIONS)
        blocks = np.einsum("bkij,blji->bkl", turned, turned)
        for places, block in zip(self.bodies, blocks, strict=True):
            hessian[np.ix_(places, places)] = block
        x, x0 = theta[self.positive], self.centre[self.positive]
        gradient[self.positive] = 1 / x0 - 1 / x
        hessian[self.positive, self.positive] = 1 / x**2
        rest = self._others
        gradient[rest] = (theta - self.centre)[rest] / self.scale[rest] ** 2
        hessian[rest, rest] = 1 / self.scale[rest] ** 2
        return gradient, hessian

    @cached_property
    def _others(self) -> Array:
        taken = np.concatenate([self.bodies.ravel(), self.positive])
        return np.setdiff1d(np.arange(len(self.problem.parameters)), taken)

    def nearest(self, beta: Array, R: Array) -> Array:
        """theta (p,) inside, with K theta = beta where that is possible; where it is not, K theta
        is nearest to beta in the metric |R (K theta - beta)|, R (r, r)."""
        K, size = self.problem.base.K, float(np.linalg.norm(R @ beta))
        if not np.isfinite(size):
            raise EstimationError("The base parameters are not finite: nothing can be simulated.")
        if size == 0.0:
            return self.centre
        A, b = R @ K / size, R @ beta / size
        theta = self.centre
        for weight in WEIGHTS:
            try:
                theta = self._settle(theta, A, b, weight)
            except EstimationError:
                if weight == WEIGHTS[0]:
                    raise
                break  # as near as rounding lets it come
        return self.project_exact(theta, beta)

    def project_exact(self, theta: Array, beta: Array) -> Array:
        """theta moved onto K theta = beta as the divergence's metric has it shortest; theta itself
        where no such body can exist."""
        moved = theta + self.lift_of(theta) @ (beta - self.problem.base.K @ theta)
        return moved if np.isfinite(self.divergence(moved)) else theta

    def lift_of(self, theta: Array) -> Array:
        """L (p, r) with K L = 1: how theta follows a change of beta, away from what cannot be."""
        K = self.problem.base.K
        spread = _solve(self.gradients(theta)[1], K.T)
        return np.linalg.solve((K @ spread).T, spread.T).T

    def step_limit(self, theta: Array, direction: Array) -> float:
        """How far a step along a direction (p,) may go with every body still possible: to half of
        the ellipsoid that the divergence's Hessian spans around theta (Dikin 1967)."""
        size = float(np.sqrt(direction @ self.gradients(theta)[1] @ direction))
        return 0.5 / size if size > 0 else np.inf

    def _settle(self, theta: Array, A: Array, b: Array, weight: float) -> Array:
        """Newton's method on |A theta - b|^2 / 2 + weight * divergence."""

        def cost(x: Array) -> float:
            misfit = A @ x - b
            return 0.5 * float(misfit @ misfit) + weight * self.divergence(x)

        now = cost(theta)
        for _ in range(30):
            gradient, hessian = self.gradients(theta)
            gradient = A.T @ (A @ theta - b) + weight * gradient
            step = -_solve(A.T @ A + weight * hessian, gradient)
            expected = -float(gradient @ step)
            if expected <= 1e-3 * weight:  # a tenth of the divergence's own curvature
                break
            length = 1.0
            while length > 1e-6 and cost(theta + length * step) > now - 0.1 * length * expected:
                length *= 0.5
            if length <= 1e-6:
                break
            theta = theta + length * step
            now = cost(theta)
        return theta


def simulatable_set(problem: Problem) -> SimulatableSet:
    """What can be simulated of a problem's unknowns, around its prior where there is one."""
    first = _first_centre(problem)
    if problem.prior is None:
        return SimulatableSet(problem, first)
    return SimulatableSet(problem, _inside(SimulatableSet(problem, first), problem.prior))


def _first_centre(problem: Problem) -> Array:
    mass, radius = FIRST_CENTRE
    centre = np.array([float(name.endswith(POSITIVE)) for name in problem.parameters])
    places = {name: i for i, name in enumerate(problem.parameters)}
    moment = 2 * mass * radius**2
    for body in problem.bodies:
        at = [places[column] for column in body.columns]
        centre[at] = [mass, 0, 0, 0, moment, 0, 0, moment, 0, moment]
    return centre


def _inside(first: SimulatableSet, prior: Prior) -> Array:
    """The prior, with a little of the first centre where it lies on the border or beyond."""
    theta = prior.theta.copy()
    for places in first.bodies:
        body, centre = theta[places], first.centre[places]
        share = SMALLEST
        while not _positive_definite(pseudo_inertia(body)[None]):
            body, share = body + share * centre, 10 * share
        theta[places] = body
    at = first.positive
    theta[at] = np.where(theta[at] > 0, theta[at], SMALLEST * first.centre[at])
    return theta


def _positive_definite(J: Array) -> bool:
    """Whether pseudo-inertias (nb, 4, 4) are, and not by rounding alone."""
    diagonal = np.diagonal(J, axis1=1, axis2=2)
    if not (diagonal > 0).all():
        return False
    scale = 1.0 / np.sqrt(diagonal)
    try:
        factor = np.linalg.cholesky(scale[:, :, None] * J * scale[:, None, :])
    except np.linalg.LinAlgError:
        return False
    return bool((np.diagonal(factor, axis1=1, axis2=2) > BORDER).all())


def _solve(H: Array, b: Array) -> Array:
    """H^-1 b for a positive definite H whose rows differ in size by many orders; what rounding
    takes from its smallest directions is given back, a little more each time it fails."""
    scale = 1.0 / np.sqrt(np.diag(H))
    even = scale[:, None] * H * scale
    for share in (0.0, 1e-14, 1e-12, 1e-10, 1e-8):
        try:
            factor = cho_factor(even + share * np.eye(len(even)))
        except np.linalg.LinAlgError:
            continue
        return (scale * cho_solve(factor, (scale * b.T).T).T).T
    raise EstimationError(
        "No bodies are found that explain these torques: the numbers differ too much in size."
    )


_DIRECTIONS = pseudo_inertia(np.eye(10))
