"""Entropic fits: the log-det divergence from the prior, by Newton's method.

d(J, J0) = -log det J + tr(J0^-1 J) + log det J0 - 4, the Bregman divergence of -log det (Lee,
Wensing, Park 2020): it does not depend on frames or units, and keeps every body inside of what can
exist. Joint terms that are not negative have the same in one dimension, -log f + f / f0; the others
are drawn quadratically.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.physical import BASIS, Physical
from sysid_bench.types import Array

DECREMENT: Final = 1e-10
"""Newton's decrement, relative to the weight of the divergence, at which the fit is at rest."""


@dataclass(frozen=True, eq=False)
class Divergence:
    """d(x, x0) of all bodies and joint terms; x0 (p,) has to be strictly possible."""

    of: Physical
    x0: Array
    free: Array  # places of what has no sign
    pull: Array  # 1 / variance of those
    linear: Array  # (p,): derivative of tr(J0^-1 J) + f / f0

    def value(self, x: Array) -> float:
        """Up to a constant; infinite outside of what can exist."""
        terms = x[self.of.not_negative]
        if terms.min(initial=1.0) <= 0:
            return np.inf
        try:
            roots = np.linalg.cholesky(self.of.pseudo_inertias(x))
        except np.linalg.LinAlgError:
            return np.inf
        logs = 2 * np.log(np.einsum("bii->bi", roots)).sum() + np.log(terms).sum()
        away = x[self.free] - self.x0[self.free]
        return float(self.linear @ x - logs + 0.5 * self.pull @ away**2)

    def derivatives(self, x: Array) -> tuple[Array, Array]:
        """Gradient (p,) and Hessian (p, p)."""
        of, p = self.of, len(x)
        gradient, hessian = self.linear.copy(), np.zeros((p, p))
        # tr(J^-1 E_k), and tr(J^-1 E_k J^-1 E_l).
        inner = np.einsum("bij,kjl->bkil", np.linalg.inv(of.pseudo_inertias(x)), BASIS)
        gradient[of.places] -= np.einsum("bkii->bk", inner)
        nb = len(of.places)
        flat, turned = inner.reshape(nb, 10, 16), inner.swapaxes(2, 3).reshape(nb, 10, 16)
        hessian[of.places[:, :, None], of.places[:, None, :]] = flat @ turned.swapaxes(1, 2)
        at = of.not_negative
        gradient[at] -= 1 / x[at]
        hessian[at, at] = 1 / x[at] ** 2
        gradient[self.free] += self.pull * (x[self.free] - self.x0[self.free])
        hessian[self.free, self.free] = self.pull
        return gradient, hessian


def divergence(of: Physical, x0: Array, std: Array) -> Divergence:
    """The divergence from x0 (p,); `std` (p,) that of the terms that have no sign."""
    signed = np.ones(len(x0), dtype=bool)
    signed[of.places] = signed[of.not_negative] = False
    free, linear = np.flatnonzero(signed), np.zeros(len(x0))
    inverse = np.linalg.inv(of.pseudo_inertias(x0))
    linear[of.places] = np.einsum("bij,kji->bk", inverse, BASIS)
    linear[of.not_negative] = 1 / x0[of.not_negative]
    return Divergence(of, x0, free, 1 / np.maximum(std[free], 1e-6) ** 2, linear)


def newton(
    A: Array, z: Array, weight: float, from_prior: Divergence, iterations: int = 100
) -> tuple[Array, int, float]:
    """(x, iterations, decrement) of min |A x - z|^2 / 2 + weight d(x, x0), started at x0.

    Convex, so that damped Newton ends at its only minimum. Raises EstimationError where it does not.
    """
    gram, x = A.T @ A, from_prior.x0
    value = 0.5 * float(np.sum((A @ x - z) ** 2)) + weight * from_prior.value(x)
    for iteration in range(1, iterations + 1):
        gradient, hessian = from_prior.derivatives(x)
        gradient = A.T @ (A @ x - z) + weight * gradient
        hessian = gram + weight * hessian
        size = 1 / np.sqrt(np.diag(hessian))
        factor = cho_factor(hessian * size * size[:, None], overwrite_a=True, check_finite=False)
        move = -size * cho_solve(factor, size * gradient, check_finite=False)
        decrement = float(-gradient @ move)
        if decrement <= DECREMENT * weight:
            return x, iteration, decrement
        x, value, moved = _searched(A, z, weight, from_prior, x, move, value, decrement)
        if not moved:  # what is left is rounding error
            return x, iteration, decrement
    raise EstimationError(
        f"Newton's method did not come to rest in {iterations} iterations: the prior and the "
        "data are too far apart; check the units of both."
    )


def _searched(
    A: Array,
    z: Array,
    weight: float,
    d: Divergence,
    x: Array,
    move: Array,
    value: float,
    slope: float,
) -> tuple[Array, float, bool]:
    """The first halving of the step that goes down enough, its value, and whether there is one."""
    share = 1.0
    while share > 1e-12:
        further = x + share * move
        new = 0.5 * float(np.sum((A @ further - z) ** 2)) + weight * d.value(further)
        if new <= value - 1e-4 * share * slope:
            return further, new, True
        share *= 0.5
    return x, value, False
