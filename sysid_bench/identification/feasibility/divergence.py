"""Fits with the log-det divergence from the prior, by a primal-dual interior-point method.

d(J, J0) = -log det J + tr(J0^-1 J) + log det J0 - 4 is the Bregman divergence of -log det (Lee,
Wensing, Park 2020): invariant to frames and units, and a barrier of physical consistency.
Non-negative joint terms have its one-dimensional form -log f + f / f0; terms of either sign have a
quadratic penalty.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import BASIS, BaseCoordinates, FeasibleSet
from sysid_bench.types import Array

DECREMENT: Final = 1e-10
"""Newton decrement at convergence, relative to the weight of the divergence."""

FIRST: Final = 1e-6
"""First barrier parameter relative to the mean square: small is fast, large is robust."""

CENTRAL: Final = 1.01
"""Largest mean of J Z, relative to the weight, that counts as on the central path."""

ROUNDED: Final = 1e-3
"""Newton decrement at convergence where it no longer decreases because of rounding."""

MOST: Final = 150
"""Most iterations; whole humanoids with exact data take about 40."""

WITHIN: Final = 0.95
"""Largest share of the distance to the boundary of the feasible set that a step takes."""


@dataclass(frozen=True, eq=False)
class Divergence:
    """d(x, x0) of all bodies and joint terms; x0 (p,) must be strictly feasible."""

    feasible: FeasibleSet
    x0: Array
    free: Array  # indices of the terms of either sign
    pull: Array  # 1 / variance of those
    linear: Array  # (p,): derivative of tr(J0^-1 J) + f / f0

    def value(self, x: Array) -> float:
        """Divergence up to a constant; infinite outside the feasible set."""
        terms = x[self.feasible.nonnegative]
        if terms.min(initial=1.0) <= 0:
            return np.inf
        try:
            roots = np.linalg.cholesky(self.feasible.pseudo_inertia(x))
        except np.linalg.LinAlgError:
            return np.inf
        # log det J = 2 sum log diag of the Cholesky factor: no overflow of the determinant.
        logs = 2 * np.log(np.einsum("bii->bi", roots)).sum() + np.log(terms).sum()
        away = x[self.free] - self.x0[self.free]
        return float(self.linear @ x - logs + 0.5 * self.pull @ away**2)

    @property
    def metric(self) -> Array:
        """Hessian (p, p) at x0: the affine-invariant metric."""
        feasible, out = self.feasible, np.zeros((len(self.x0), len(self.x0)))
        inverse = np.linalg.inv(feasible.pseudo_inertia(self.x0))
        out[feasible.indices[:, :, None], feasible.indices[:, None, :]] = _metric_blocks(inverse)
        out[feasible.nonnegative, feasible.nonnegative] = 1 / self.x0[feasible.nonnegative] ** 2
        out[self.free, self.free] = self.pull
        return out


def _metric_blocks(S: Array) -> Array:
    """tr(S E_k S E_l) (nb, 10, 10) of symmetric S (nb, 4, 4), E_k = dJ / dx_k."""
    left, right = S[:, None] @ BASIS, BASIS @ S[:, None]
    return np.asarray(left.reshape(-1, 10, 16) @ right.reshape(-1, 10, 16).swapaxes(1, 2))


def divergence(feasible: FeasibleSet, x0: Array, std: Array) -> Divergence:
    """Divergence from x0 (p,); `std` (p,): standard deviations, for the terms of either sign."""
    signed = np.ones(len(x0), dtype=bool)
    signed[feasible.indices] = signed[feasible.nonnegative] = False
    free, linear = np.flatnonzero(signed), np.zeros(len(x0))
    inverse = np.linalg.inv(feasible.pseudo_inertia(x0))
    linear[feasible.indices] = np.einsum("bij,kji->bk", inverse, BASIS)
    # d log det J0 at J0 is tr(J0^-1 dJ): the divergence has a zero gradient at the prior.
    linear[feasible.nonnegative] = 1 / x0[feasible.nonnegative]
    return Divergence(feasible, x0, free, 1 / np.maximum(std[free], 1e-6) ** 2, linear)


def newton(
    from_prior: Divergence, coordinates: BaseCoordinates, weight: float, y: Array
) -> tuple[Array, int, float]:
    """Minimise |y[:rank]|^2 / 2 + weight d(x(y), x0) from y; return (x, iterations, decrement).

    A primal Newton method converges slowly along the boundary. The dual Z of J satisfies J Z =
    weight 1 at the solution: Nesterov-Todd directions (1997), with Mehrotra's choice of the barrier
    parameter. The problem is convex with a unique minimum. Raises EstimationError where it does not
    converge.
    """
    if len(y) == 0:  # all parameters are determined
        return coordinates.x(y), 0, 0.0
    squares = float(np.sum(y[: coordinates.rank] ** 2)) / len(y)
    mu, feasible, x = max(weight, FIRST * squares), from_prior.feasible, coordinates.x(y)
    # On the central path J Z = mu 1.
    Z, z = mu * np.linalg.inv(feasible.pseudo_inertia(x)), mu / x[feasible.nonnegative]
    iterate, before = _Iterate(from_prior, coordinates, weight, y, Z, z), np.inf
    for iteration in range(1, MOST + 1):
        try:
            step = iterate.direction(weight)
            # The second way out is rounding: on the central path each decrement would else be far
            # below half of the last.
            if step.decrement <= DECREMENT * weight or (
                iterate.mu <= CENTRAL * weight and ROUNDED * weight >= step.decrement > 0.5 * before
            ):
                return coordinates.x(iterate.y), iteration, step.decrement
            iterate, before = iterate.updated(iterate.centred_step(step)), step.decrement
        except np.linalg.LinAlgError:  # at the boundary, within rounding
            break
    raise EstimationError(
        f"The fit did not converge in {iteration} iterations: the prior and the data are too far "
        "apart; check the units of both."
    )


@dataclass(frozen=True, eq=False)
class _Step:
    """Search direction, its Newton decrement, and the step length to the boundary."""

    y: Array
    Z: Array
    z: Array
    decrement: float
    step_limit: float


@dataclass(frozen=True, eq=False)
class _Iterate:
    """y with its duals Z (nb, 4, 4) of the bodies and z (k,) of the joint terms."""

    d: Divergence
    coordinates: BaseCoordinates
    weight: float
    y: Array
    Z: Array
    z: Array

    @cached_property
    def x(self) -> Array:
        """x (p,)."""
        return self.coordinates.x(self.y)

    @cached_property
    def terms(self) -> Array:
        """Non-negative joint terms (k,) of x."""
        return np.asarray(self.x[self.d.feasible.nonnegative])

    @cached_property
    def J(self) -> Array:
        """Pseudo-inertias (nb, 4, 4)."""
        return self.d.feasible.pseudo_inertia(self.x)

    @cached_property
    def roots(self) -> Array:
        """Inverse Cholesky factors of J."""
        return np.linalg.inv(np.linalg.cholesky(self.J))

    @cached_property
    def inverse(self) -> Array:
        """J^-1."""
        return np.asarray(self.roots.swapaxes(1, 2) @ self.roots)

    @cached_property
    def scaling(self) -> Array:
        """S (nb, 4, 4) with S J S = Z (Nesterov, Todd 1997)."""
        L = np.linalg.cholesky(self.J)
        values, V = np.linalg.eigh(L.swapaxes(1, 2) @ self.Z @ L)
        half = V.swapaxes(1, 2) @ self.roots
        return np.asarray(
            half.swapaxes(1, 2) @ (np.sqrt(np.maximum(values, 0.0))[:, :, None] * half)
        )

    @cached_property
    def mu(self) -> float:
        """Barrier parameter: mean eigenvalue of all J Z."""
        return self.mu_of(self.J, self.Z, self.terms, self.z)

    def mu_of(self, J: Array, Z: Array, terms: Array, z: Array) -> float:
        return float((np.sum(J * Z) + terms @ z) / (4 * len(J) + len(z)))

    @cached_property
    def solve(self) -> Callable[[Array], Array]:
        """Newton's matrix, factored: the map of a gradient (m,) to a direction."""
        d, feasible, T = self.d, self.d.feasible, self.coordinates.T
        # Nesterov-Todd scaling: S with S J S = Z takes the place of J^-1 in the Hessian of -log
        # det.
        curved = np.empty_like(T)  # Hessian by x, block diagonal, times T
        places, blocks = feasible.indices.ravel(), _metric_blocks(self.scaling)
        curved[places] = (blocks @ T[feasible.indices]).reshape(-1, T.shape[1])
        curved[feasible.nonnegative] = (self.z / self.terms)[:, None] * T[feasible.nonnegative]
        curved[d.free] = self.weight * d.pull[:, None] * T[d.free]
        hessian = T.T @ curved
        inner = np.arange(self.coordinates.rank)
        # |u|^2 / 2 of the data: the coordinates make its Hessian the identity.
        hessian[inner, inner] += 1.0
        # With a diagonal of one; where rounding has made it indefinite, the least multiple of the
        # unit matrix that restores it is added.
        size = 1 / np.sqrt(np.diag(hessian))
        scaled = hessian * size * size[:, None]
        more = 0.0
        while True:
            try:
                factor = cho_factor(scaled + more * np.eye(len(size)), check_finite=False)
                break
            except np.linalg.LinAlgError:
                more = max(100.0 * more, 1e-14)
        return lambda g: np.asarray(-size * cho_solve(factor, size * g, check_finite=False))

    def direction(self, target: float) -> _Step:
        """Newton direction towards J Z = target 1."""
        d, feasible, coordinates = self.d, self.d.feasible, self.coordinates
        slope = self.weight * d.linear
        slope[feasible.indices] -= target * np.einsum("bij,kji->bk", self.inverse, BASIS)
        slope[feasible.nonnegative] -= target / self.terms
        slope[d.free] += self.weight * d.pull * (self.x[d.free] - d.x0[d.free])
        gradient = coordinates.T.T @ slope
        gradient[: coordinates.rank] += self.y[: coordinates.rank]
        y = self.solve(gradient)
        x = coordinates.T @ y
        J, terms = feasible.pseudo_inertia(x), x[feasible.nonnegative]
        Z = target * self.inverse - self.Z - self.scaling @ J @ self.scaling
        z = (target - self.z * terms) / self.terms - self.z
        dual_roots = np.linalg.inv(np.linalg.cholesky(self.Z))
        step_limit = min(
            _step_limit(self.roots, J, self.terms, terms), _step_limit(dual_roots, Z, self.z, z)
        )
        return _Step(y, Z, z, float(-gradient @ y), step_limit)

    def centred_step(self, step: _Step) -> _Step:
        """The step to take, given the one that aims at the weight directly: a larger barrier
        parameter where that one soon reaches the boundary (Mehrotra's rule, third power of the
        predicted reduction)."""
        share = min(1.0, WITHIN * step.step_limit)
        if self.mu <= CENTRAL * self.weight or share > 0.9:
            return step
        x = self.x + share * (self.coordinates.T @ step.y)
        left = self.mu_of(
            self.d.feasible.pseudo_inertia(x), self.Z + share * step.Z,
            x[self.d.feasible.nonnegative], self.z + share * step.z,
        ) / self.mu  # fmt: skip
        # The more of the gap the trial step closes, the smaller the next target.
        target = self.mu * min(max(left, 0.0), 1.0) ** 3
        return self.direction(target) if target > self.weight else step

    def updated(self, step: _Step) -> "_Iterate":
        """Iterate after a step; one step length for primal and dual, which the squares couple."""
        share = min(1.0, WITHIN * step.step_limit)
        return replace(
            self,
            y=self.y + share * step.y, Z=self.Z + share * step.Z, z=self.z + share * step.z,
        )  # fmt: skip


def _step_limit(roots: Array, direction: Array, terms: Array, more: Array) -> float:
    """Step length at which the change `direction` (nb, 4, 4), or `more` (k,), reaches the boundary,
    for bodies with the inverse Cholesky factors `roots` and the joint terms `terms` (k,)."""
    # J + t D > 0 iff 1 + t L^-1 D L^-T > 0: the smallest eigenvalue gives the largest t.
    turned = roots @ direction @ roots.swapaxes(1, 2)
    most = max(
        -float(np.linalg.eigvalsh(turned).min(initial=0.0)), -float((more / terms).min(initial=0.0))
    )
    return 1.0 / most if most > 0 else np.inf
