"""Log-Cholesky coordinates of bodies and joint terms, and least squares in them.

J = U U' with U = exp(a) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3],
[0, 0, 0, 1]] (Rucker and Wensing 2022, eq. 9). Joint terms that are not negative are exponentials
too; the others are taken as they are.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.physical import BASIS, Physical
from sysid_bench.types import Array

_OFF = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # s12 s23 s13 t1 t2 t3
_OF_MATRIX = np.linalg.pinv(BASIS.reshape(10, 16).T)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """eta (p,), at the places of x: a, d1, d2, d3, s12, s23, s13, t1, t2, t3 of each body."""

    of: Physical
    eta0: Array

    def x(self, eta: Array) -> Array:
        """x (p,)."""
        x = eta.copy()
        x[self.of.not_negative] = np.exp(eta[self.of.not_negative])
        U = _upper(eta[self.of.places])
        x[self.of.places] = (U @ U.swapaxes(1, 2)).reshape(-1, 16) @ _OF_MATRIX.T
        return x

    def jacobian(self, eta: Array) -> Array:
        """dx / deta (p, p)."""
        of, out = self.of, np.eye(len(eta))
        out[of.not_negative, of.not_negative] = np.exp(eta[of.not_negative])
        bodies = eta[of.places]
        U, dU = _upper(bodies), _slopes(bodies)
        half = dU @ U[:, None].swapaxes(2, 3)
        turned = (half + half.swapaxes(2, 3)).reshape(len(U), 10, 16) @ _OF_MATRIX.T
        out[of.places[:, :, None], of.places[:, None, :]] = turned.swapaxes(1, 2)
        return out


def coordinates(of: Physical, x0: Array) -> Coordinates:
    """The coordinates, and eta of a strictly possible x0 (p,)."""
    eta = x0.copy()
    eta[of.not_negative] = np.log(x0[of.not_negative])
    turned = of.pseudo_inertias(x0)[:, ::-1, ::-1]
    U = np.linalg.cholesky(turned)[:, ::-1, ::-1]
    last = U[:, 3, 3]
    diagonal = np.einsum("bii->bi", U)[:, :3]
    off = np.stack([U[:, i, j] for i, j in _OFF], axis=1)
    eta[of.places] = np.hstack(
        [np.log(last)[:, None], np.log(diagonal / last[:, None]), off / last[:, None]]
    )
    return Coordinates(of, eta)


def levenberg_marquardt(
    A: Array, z: Array, at: Coordinates, weight: float, iterations: int
) -> tuple[Array, int, float]:
    """(x, iterations, decrement) of min |A x(eta) - z|^2 / 2 + weight |eta - eta0|^2 / 2 from eta0.

    Raises EstimationError where it does not come to rest.
    """
    eta, damping = at.eta0, 1e-3
    value = _value(A, z, at, weight, eta)
    for iteration in range(1, iterations + 1):
        rest = A @ at.x(eta) - z
        J = A @ at.jacobian(eta)
        gradient = J.T @ rest + weight * (eta - at.eta0)
        hessian = J.T @ J + weight * np.eye(len(eta))
        size = 1 / np.sqrt(np.diag(hessian))
        scaled = hessian * size * size[:, None]
        decrement = float(gradient @ _step(scaled, size, gradient, 0.0))
        if decrement <= 1e-9 * weight:
            return at.x(eta), iteration, decrement
        while True:
            further = eta - _step(scaled, size, gradient, damping)
            new = _value(A, z, at, weight, further)
            if new < value:
                break
            if damping > 1e12:  # what is left is rounding error
                return at.x(eta), iteration, decrement
            damping *= 8.0
        eta, value, damping = further, new, max(damping / 8.0, 1e-12)
    raise EstimationError(
        f"Log-Cholesky least squares did not come to rest in {iterations} iterations; allow more, "
        "or weigh the prior more."
    )


def _step(scaled: Array, size: Array, gradient: Array, damping: float) -> Array:
    damped = scaled + damping * np.eye(len(size))
    return np.asarray(size * cho_solve(cho_factor(damped), size * gradient))


def _value(A: Array, z: Array, at: Coordinates, weight: float, eta: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        x = at.x(eta)
        value = 0.5 * np.sum((A @ x - z) ** 2) + 0.5 * weight * np.sum((eta - at.eta0) ** 2)
    return float(value) if np.isfinite(value) else np.inf


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
