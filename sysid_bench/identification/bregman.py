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
from sysid_bench.identification.base_coordinates import BaseCoordinates
from sysid_bench.identification.physical import BASIS, Physical
from sysid_bench.types import Array

DECREMENT: Final = 1e-10
"""Newton's decrement, relative to the weight of the divergence, at which the fit is at rest."""

ON_THE_WAY: Final = 0.1
"""The same where the fit is only led somewhere."""

DIRECT: Final = 20
"""Iterations that most fits need fewer than."""

LED: Final = 100
"""Iterations for each weight on the way, at most."""

STAGE: Final = 10.0
"""By how much the leading weight sinks at a time."""


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

    def room(self, x: Array, move: Array) -> float:
        """The share of a move (p,) that leaves every body and joint term a hundredth of itself: on
        the edge of what can exist curvature is all there is, and Newton's steps are small."""
        roots = np.linalg.inv(np.linalg.cholesky(self.of.pseudo_inertias(x)))
        turned = roots @ self.of.pseudo_inertias(move) @ roots.swapaxes(1, 2)
        terms = self.of.not_negative
        most = max(
            -float(np.linalg.eigvalsh(turned).min(initial=0.0)),
            -float((move[terms] / x[terms]).min(initial=0.0)),
        )
        return 0.99 / most if most > 0 else np.inf

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
    from_prior: Divergence, at: BaseCoordinates, weight: float, y: Array
) -> tuple[Array, int, float]:
    """(x, iterations, decrement) of min |y[:rank]|^2 / 2 + weight d(x(y), x0), started at y.

    Convex, so that damped Newton ends at its only minimum. Squares that are large beside the weight
    may drive it to the edge of what can exist, where it creeps: then larger weights lead it.
    Raises EstimationError where it does not come to rest.
    """
    count = 0
    try:
        found, count, decrement = _newton(
            from_prior, at, weight, y, DIRECT, DECREMENT, inside=False
        )
        if count < DIRECT:
            return at.x(found), count, decrement
    except np.linalg.LinAlgError:
        pass  # on the edge, where the curvature is beyond numbers
    leading = max(weight, float(np.sum(y[: at.rank] ** 2)) / len(y))
    while True:
        rest = DECREMENT if leading == weight else ON_THE_WAY
        y, more, decrement = _newton(from_prior, at, leading, y, LED, rest, inside=True)
        count += more
        if leading == weight:
            break
        leading = max(weight, leading / STAGE)
    if more == LED:
        raise EstimationError(
            f"Newton's method did not come to rest in {count} iterations: the prior and the data "
            "are too far apart; check the units of both."
        )
    return at.x(y), count, decrement


def _newton(
    d: Divergence,
    at: BaseCoordinates,
    weight: float,
    y: Array,
    most: int,
    rest: float,
    inside: bool,
) -> tuple[Array, int, float]:
    """(y, iterations, decrement) after `most` iterations, or where the decrement over the weight is
    `rest` or nothing goes down any more; `inside`: no step comes near the edge."""
    squares = np.append(np.ones(at.rank), np.zeros(at.T.shape[1] - at.rank))

    def value(y: Array) -> float:
        return 0.5 * float(squares @ y**2) + weight * d.value(at.x(y))

    now = value(y)
    for iteration in range(1, most + 1):
        gradient, hessian = d.derivatives(at.x(y))
        gradient = squares * y + weight * (at.T.T @ gradient)
        move = _newton_step(gradient, np.diag(squares) + weight * (at.T.T @ (hessian @ at.T)))
        decrement = float(-gradient @ move)
        if decrement <= rest * weight:
            return y, iteration, decrement
        share = min(1.0, d.room(at.x(y), at.T @ move)) if inside else 1.0
        while not (new := value(y + share * move)) <= now - 1e-4 * share * decrement:
            share *= 0.5
            if share < 1e-12:  # what is left is rounding error
                return y, iteration, decrement
        y, now = y + share * move, new
    return y, most, decrement


def _newton_step(gradient: Array, hessian: Array) -> Array:
    """-H^-1 g, with coordinates scaled to a diagonal of ones; where rounding has made H indefinite,
    with as much more on the diagonal as it takes."""
    size = 1 / np.sqrt(np.diag(hessian))
    scaled = hessian * size * size[:, None]
    more = 0.0
    while True:
        try:
            factor = cho_factor(scaled + more * np.eye(len(size)), check_finite=False)
            return np.asarray(-size * cho_solve(factor, size * gradient, check_finite=False))
        except np.linalg.LinAlgError:
            more = max(100.0 * more, 1e-14)
