"""Entropic fits: the log-det divergence from the prior, by a primal-dual interior-point method.

d(J, J0) = -log det J + tr(J0^-1 J) + log det J0 - 4, the Bregman divergence of -log det (Lee,
Wensing, Park 2020): it does not depend on frames or units, and keeps every body inside of what can
exist. Joint terms that are not negative have the same in one dimension, -log f + f / f0; the others
are drawn quadratically.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import BASIS, FeasibleSet
from sysid_bench.identification.linear.base_coordinates import BaseCoordinates
from sysid_bench.types import Array

DECREMENT: Final = 1e-10
"""Newton's decrement, relative to the weight of the divergence, at which the fit is at rest."""

FIRST: Final = 1e-6
"""The first products J Z over the mean square: small ones are quick, large ones lead far."""

CENTRAL: Final = 1.01
"""Times the weight: products J Z that are as they shall be."""

ROUNDED: Final = 1e-3
"""The same where it no longer sinks: what is left is rounding."""

MOST: Final = 150
"""Iterations; whole humanoids with exact data need about 40."""

WITHIN: Final = 0.95
"""The share of the way to the edge of what can exist that a step takes at most."""


@dataclass(frozen=True, eq=False)
class Divergence:
    """d(x, x0) of all bodies and joint terms; x0 (p,) has to be strictly possible."""

    of: FeasibleSet
    x0: Array
    free: Array  # places of what has no sign
    pull: Array  # 1 / variance of those
    linear: Array  # (p,): derivative of tr(J0^-1 J) + f / f0

    def value(self, x: Array) -> float:
        """Up to a constant; infinite outside of what can exist."""
        terms = x[self.of.nonnegative]
        if terms.min(initial=1.0) <= 0:
            return np.inf
        try:
            roots = np.linalg.cholesky(self.of.pseudo_inertias(x))
        except np.linalg.LinAlgError:
            return np.inf
        logs = 2 * np.log(np.einsum("bii->bi", roots)).sum() + np.log(terms).sum()
        away = x[self.free] - self.x0[self.free]
        return float(self.linear @ x - logs + 0.5 * self.pull @ away**2)

    @property
    def metric(self) -> Array:
        """The Hessian (p, p) at x0."""
        of, out = self.of, np.zeros((len(self.x0), len(self.x0)))
        inverse = np.linalg.inv(of.pseudo_inertias(self.x0))
        out[of.places[:, :, None], of.places[:, None, :]] = rotated_coordinates(inverse)
        out[of.nonnegative, of.nonnegative] = 1 / self.x0[of.nonnegative] ** 2
        out[self.free, self.free] = self.pull
        return out


def rotated_coordinates(S: Array) -> Array:
    """tr(S E_k S E_l) (nb, 10, 10) of symmetric S (nb, 4, 4), E_k = dJ / dx_k."""
    left, right = S[:, None] @ BASIS, BASIS @ S[:, None]
    return left.reshape(-1, 10, 16) @ right.reshape(-1, 10, 16).swapaxes(1, 2)


def divergence(of: FeasibleSet, x0: Array, std: Array) -> Divergence:
    """The divergence from x0 (p,); `std` (p,) that of the terms that have no sign."""
    signed = np.ones(len(x0), dtype=bool)
    signed[of.places] = signed[of.nonnegative] = False
    free, linear = np.flatnonzero(signed), np.zeros(len(x0))
    inverse = np.linalg.inv(of.pseudo_inertias(x0))
    linear[of.places] = np.einsum("bij,kji->bk", inverse, BASIS)
    linear[of.nonnegative] = 1 / x0[of.nonnegative]
    return Divergence(of, x0, free, 1 / np.maximum(std[free], 1e-6) ** 2, linear)


def newton(
    from_prior: Divergence, at: BaseCoordinates, weight: float, y: Array
) -> tuple[Array, int, float]:
    """(x, iterations, decrement) of min |y[:rank]|^2 / 2 + weight d(x(y), x0), started at y.

    Newton's method on the divergence alone creeps along the edge of what can exist. Beside J stands
    its dual Z, until J Z = weight 1: directions of Nesterov and Todd, and Mehrotra's choice of how
    much nearer to that a step goes. Convex, so that it ends at the only minimum. Raises
    EstimationError where it does not come to rest.
    """
    if len(y) == 0:  # nothing is left to choose
        return at.x(y), 0, 0.0
    squares = float(np.sum(y[: at.rank] ** 2)) / len(y)
    here, before = _start(from_prior, at, weight, y, max(weight, FIRST * squares)), np.inf
    for iteration in range(1, MOST + 1):
        try:
            last = here.move(weight)
            if last.decrement <= DECREMENT * weight or (
                here.mu <= CENTRAL * weight and ROUNDED * weight >= last.decrement > 0.5 * before
            ):
                return at.x(here.y), iteration, last.decrement
            here, before = here.after(here.led(last)), last.decrement
        except np.linalg.LinAlgError:  # on the edge, where numbers end
            break
    raise EstimationError(
        f"The fit did not come to rest in {iteration} iterations: the prior and the data are too "
        "far apart; check the units of both."
    )


@dataclass(frozen=True, eq=False)
class _Move:
    """A direction from a place, and how far it goes before something cannot exist."""

    y: Array
    Z: Array
    z: Array
    decrement: float
    room: float


@dataclass(frozen=True, eq=False)
class _Place:
    """y with its duals Z (nb, 4, 4) and z (k,), those of the joint terms."""

    d: Divergence
    at: BaseCoordinates
    weight: float
    y: Array
    Z: Array
    z: Array

    @cached_property
    def x(self) -> Array:
        """x (p,)."""
        return self.at.x(self.y)

    @cached_property
    def terms(self) -> Array:
        """Of x those that are not negative (k,)."""
        return self.x[self.d.of.nonnegative]

    @cached_property
    def J(self) -> Array:
        """Pseudo-inertias (nb, 4, 4)."""
        return self.d.of.pseudo_inertias(self.x)

    @cached_property
    def roots(self) -> Array:
        """Inverse Cholesky factors of J."""
        return np.linalg.inv(np.linalg.cholesky(self.J))

    @cached_property
    def inverse(self) -> Array:
        """J^-1."""
        return self.roots.swapaxes(1, 2) @ self.roots

    @cached_property
    def scaling(self) -> Array:
        """S (nb, 4, 4) with S J S = Z (Nesterov, Todd 1997)."""
        L = np.linalg.cholesky(self.J)
        values, V = np.linalg.eigh(L.swapaxes(1, 2) @ self.Z @ L)
        half = V.swapaxes(1, 2) @ self.roots
        return half.swapaxes(1, 2) @ (np.sqrt(np.maximum(values, 0.0))[:, :, None] * half)

    @cached_property
    def mu(self) -> float:
        """The mean of the eigenvalues of all J Z."""
        return self.mu_of(self.J, self.Z, self.terms, self.z)

    def mu_of(self, J: Array, Z: Array, terms: Array, z: Array) -> float:
        return float((np.sum(J * Z) + terms @ z) / (4 * len(J) + len(z)))

    @cached_property
    def solve(self) -> Callable[[Array], Array]:
        """Newton's matrix, factored: a gradient (m,) becomes a direction."""
        d, of, T = self.d, self.d.of, self.at.T
        curved = np.empty_like(T)  # the Hessian by x, body by body, times T
        places, blocks = of.places.ravel(), rotated_coordinates(self.scaling)
        curved[places] = (blocks @ T[of.places]).reshape(-1, T.shape[1])
        curved[of.nonnegative] = (self.z / self.terms)[:, None] * T[of.nonnegative]
        curved[d.free] = self.weight * d.pull[:, None] * T[d.free]
        hessian = T.T @ curved
        inner = np.arange(self.at.rank)
        hessian[inner, inner] += 1.0
        return _factored(hessian)

    def move(self, target: float) -> _Move:
        """The direction to where J Z = target 1; its decrement counts for target = weight."""
        d, of, at = self.d, self.d.of, self.at
        slope = self.weight * d.linear
        slope[of.places] -= target * np.einsum("bij,kji->bk", self.inverse, BASIS)
        slope[of.nonnegative] -= target / self.terms
        slope[d.free] += self.weight * d.pull * (self.x[d.free] - d.x0[d.free])
        gradient = at.T.T @ slope
        gradient[: at.rank] += self.y[: at.rank]
        y = self.solve(gradient)
        x = at.T @ y
        J, terms = of.pseudo_inertias(x), x[of.nonnegative]
        Z = target * self.inverse - self.Z - self.scaling @ J @ self.scaling
        z = (target - self.z * terms) / self.terms - self.z
        dual_roots = np.linalg.inv(np.linalg.cholesky(self.Z))
        room = min(_room(self.roots, J, self.terms, terms), _room(dual_roots, Z, self.z, z))
        return _Move(y, Z, z, float(-gradient @ y), room)

    def led(self, last: _Move) -> _Move:
        """The move to take where `last` leads to the weight at once: a nearer goal where that one
        is out of reach, the nearer the less of the way is free."""
        share = min(1.0, WITHIN * last.room)
        if self.mu <= CENTRAL * self.weight or share > 0.9:
            return last
        x = self.x + share * (self.at.T @ last.y)
        left = self.mu_of(
            self.d.of.pseudo_inertias(x), self.Z + share * last.Z,
            x[self.d.of.nonnegative], self.z + share * last.z,
        ) / self.mu  # fmt: skip
        target = self.mu * min(max(left, 0.0), 1.0) ** 3
        return self.move(target) if target > self.weight else last

    def after(self, move: _Move) -> "_Place":
        """The place after as much of a move as there is room for: one share for all, as squares
        tie the duals to where they belong."""
        share = min(1.0, WITHIN * move.room)
        return replace(
            self,
            y=self.y + share * move.y, Z=self.Z + share * move.Z, z=self.z + share * move.z,
        )  # fmt: skip


def _start(d: Divergence, at: BaseCoordinates, weight: float, y: Array, mu: float) -> _Place:
    x = at.x(y)
    Z = mu * np.linalg.inv(d.of.pseudo_inertias(x))
    return _Place(d, at, weight, y, Z, mu / x[d.of.nonnegative])


def _room(roots: Array, move: Array, terms: Array, more: Array) -> float:
    """The share of a move (nb, 4, 4), and of `more` (k,), that leaves nothing of some body whose
    inverse Cholesky factors are `roots`, or of some of the terms (k,)."""
    turned = roots @ move @ roots.swapaxes(1, 2)
    most = max(
        -float(np.linalg.eigvalsh(turned).min(initial=0.0)),
        -float((more / terms).min(initial=0.0)),
    )
    return 1.0 / most if most > 0 else np.inf


def _factored(hessian: Array) -> Callable[[Array], Array]:
    """g -> -H^-1 g, with coordinates scaled to a diagonal of ones; where rounding has made H
    indefinite, with as much more on the diagonal as it takes."""
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
