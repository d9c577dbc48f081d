"""Log-Cholesky coordinates of bodies and joint terms, and least squares in them.

J = U U' with U = exp(a) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3],
[0, 0, 0, 1]] (Rucker and Wensing 2022, eq. 9). Joint terms that are not negative are exponentials
too; the others are taken as they are.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import BASIS, FeasibleSet
from sysid_bench.types import Array

AT_REST: Final = 1e-9
"""Of the weight: the decrement at which the fit is at rest."""

_OFF = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # s12 s23 s13 t1 t2 t3
_OF_MATRIX = np.linalg.pinv(BASIS.reshape(10, 16).T)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """eta (p,), at the places of x: a, d1, d2, d3, s12, s23, s13, t1, t2, t3 of each body."""

    of: FeasibleSet
    eta0: Array

    def x(self, eta: Array) -> Array:
        """x (p,)."""
        x = eta.copy()
        x[self.of.nonnegative] = np.exp(eta[self.of.nonnegative])
        U = _upper(eta[self.of.places])
        x[self.of.places] = (U @ U.swapaxes(1, 2)).reshape(-1, 16) @ _OF_MATRIX.T
        return x

    def jacobian(self, eta: Array) -> Array:
        """dx / deta (p, p)."""
        of, out = self.of, np.eye(len(eta))
        out[of.nonnegative, of.nonnegative] = np.exp(eta[of.nonnegative])
        bodies = eta[of.places]
        U, dU = _upper(bodies), _slopes(bodies)
        half = dU @ U[:, None].swapaxes(2, 3)
        turned = (half + half.swapaxes(2, 3)).reshape(len(U), 10, 16) @ _OF_MATRIX.T
        out[of.places[:, :, None], of.places[:, None, :]] = turned.swapaxes(1, 2)
        return out

    def curvature(self, eta: Array, pull: Array) -> Array:
        """sum_i pull_i d2x_i / deta2 (p, p) for a gradient `pull` (p,) with respect to x."""
        of, out = self.of, np.zeros((len(eta), len(eta)))
        out[of.nonnegative, of.nonnegative] = pull[of.nonnegative] * np.exp(eta[of.nonnegative])
        bodies = eta[of.places]
        U, dU = _upper(bodies), _slopes(bodies)
        C = (pull[of.places] @ _OF_MATRIX).reshape(-1, 4, 4)
        C = 0.5 * (C + C.swapaxes(1, 2))  # pull . x = tr(C J)
        turned = (C[:, None] @ dU).reshape(len(U), 10, 16)
        block = turned @ dU.reshape(len(U), 10, 16).swapaxes(1, 2)
        single = np.einsum("bkij,bij->bk", dU, C @ U)
        block[:, 0, :] += single
        block[:, 1:, 0] += single[:, 1:]
        for k in (1, 2, 3):  # the exponentials on the diagonal are their own derivatives
            block[:, k, k] += single[:, k]
        out[of.places[:, :, None], of.places[:, None, :]] = 2 * block
        return out


def coordinates(of: FeasibleSet, x0: Array) -> Coordinates:
    """The coordinates, and eta of a strictly possible x0 (p,)."""
    eta = x0.copy()
    eta[of.nonnegative] = np.log(x0[of.nonnegative])
    turned = of.pseudo_inertias(x0)[:, ::-1, ::-1]
    U = np.linalg.cholesky(turned)[:, ::-1, ::-1]
    last = U[:, 3, 3]
    diagonal = np.einsum("bii->bi", U)[:, :3]
    off = np.stack([U[:, i, j] for i, j in _OFF], axis=1)
    eta[of.places] = np.hstack(
        [np.log(last)[:, None], np.log(diagonal / last[:, None]), off / last[:, None]]
    )
    return Coordinates(of, eta)


def damped_newton(
    rows: Array,
    origin: Array,
    at: Coordinates,
    eta: Array,
    weight: float,
    iterations: int,
) -> tuple[Array, int, float]:
    """(eta, iterations, decrement) of min |u|^2 / 2 + weight |eta - eta0|^2 / 2 from eta, with
    u (r,) = rows (x(eta) - origin).

    Levenberg's damping, with the second derivatives of x: Gauss and Newton leave them out, and then
    creep along the curved valley that exact data make. Raises EstimationError where it does not
    come to rest.
    """

    def value(eta: Array) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            u = rows @ (at.x(eta) - origin)
            found = 0.5 * float(u @ u) + 0.5 * weight * float(np.sum((eta - at.eta0) ** 2))
        return found if np.isfinite(found) else np.inf

    damping, now = 1e-3, value(eta)
    for iteration in range(1, iterations + 1):
        u, J = rows @ (at.x(eta) - origin), rows @ at.jacobian(eta)
        gradient = J.T @ u + weight * (eta - at.eta0)
        hessian = J.T @ J + weight * np.eye(len(eta))
        size = 1 / np.sqrt(np.diag(hessian))
        exact = hessian + at.curvature(eta, rows.T @ u)
        while damping <= 1e12:
            solve = _solver(exact, size, damping)
            if solve is not None:
                step = solve(gradient)
                decrement = float(gradient @ step)
                if decrement <= AT_REST * weight:
                    return eta, iteration, decrement
                further = eta - step
                # The valley curves: what the step misses of it is put right before it is judged.
                with np.errstate(over="ignore", invalid="ignore"):
                    missed = rows @ (at.x(further) - origin) - (u - J @ step)
                if np.isfinite(missed).all():  # else the exponentials left what numbers hold
                    further = further - solve(J.T @ missed)
                    new = value(further)
                    if new < now:
                        break
            damping = max(damping, 1e-9) * 8.0
        else:  # what is left is rounding error
            return eta, iteration, float(np.sum((gradient * size) ** 2))
        eta, now, damping = further, new, damping / 16.0
    raise EstimationError(
        f"Log-Cholesky least squares did not come to rest in {iterations} iterations; allow more, "
        "or weigh the prior more."
    )


def _solver(hessian: Array, size: Array, damping: float) -> Callable[[Array], Array] | None:
    """g -> (H + damping diag)^-1 g, or None where that is not positive definite."""
    scaled = hessian * size * size[:, None]
    scaled[np.diag_indices(len(size))] += damping
    try:
        factor = cho_factor(scaled, overwrite_a=True)
    except np.linalg.LinAlgError:
        return None
    return lambda gradient: np.asarray(size * cho_solve(factor, size * gradient))


def _upper(bodies: Array) -> Array:
    """U (nb, 4, 4) of eta (nb, 10)."""
    U = np.zeros((len(bodies), 4, 4))
    U[:, range(3), range(3)] = np.exp(bodies[:, 1:4])
    U[:, 3, 3] = 1.0
    for k, (i, j) in enumerate(_OFF):
        U[:, i, j] = bodies[:, 4 + k]
    return np.exp(bodies[:, 0])[:, None, None] * U


def _slopes(bodies: Array) -> Array:
    """dU / deta (nb, 10, 4, 4)."""
    U, dU = _upper(bodies), np.zeros((len(bodies), 10, 4, 4))
    dU[:, 0] = U
    for k in range(3):
        dU[:, 1 + k, k, k] = U[:, k, k]
    for k, (i, j) in enumerate(_OFF):
        dU[:, 4 + k, i, j] = np.exp(bodies[:, 0])
    return dU
