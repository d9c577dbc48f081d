"""Log-Cholesky coordinates of bodies and joint terms, and nonlinear least squares in them.

J = U U' with U = exp(a) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3],
[0, 0, 0, 1]] (Rucker and Wensing 2022, eq. 9). Non-negative joint terms are exponentials; terms of
either sign are their own coordinates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import BASIS, FeasibleSet
from sysid_bench.types import Array

CONVERGED: Final = 1e-9
"""Newton decrement at convergence, relative to the weight."""

_OFF_DIAGONAL = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # s12 s23 s13 t1 t2 t3
# The ten matrices of the basis span the symmetric ones: the least-squares inverse is exact.
_FROM_MATRIX = np.linalg.pinv(BASIS.reshape(10, 16).T)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """eta (p,), at the indices of x: a, d1, d2, d3, s12, s23, s13, t1, t2, t3 of each body."""

    feasible: FeasibleSet
    eta0: Array

    def x(self, eta: Array) -> Array:
        """x (p,)."""
        x = eta.copy()
        x[self.feasible.nonnegative] = np.exp(eta[self.feasible.nonnegative])
        U = _upper(eta[self.feasible.indices])
        x[self.feasible.indices] = (U @ U.swapaxes(1, 2)).reshape(-1, 16) @ _FROM_MATRIX.T
        return x

    def jacobian(self, eta: Array) -> Array:
        """dx / deta (p, p)."""
        feasible, out = self.feasible, np.eye(len(eta))
        out[feasible.nonnegative, feasible.nonnegative] = np.exp(eta[feasible.nonnegative])
        bodies = eta[feasible.indices]
        U, dU = _upper(bodies), _slopes(bodies)
        half = dU @ U[:, None].swapaxes(2, 3)
        products = (half + half.swapaxes(2, 3)).reshape(len(U), 10, 16) @ _FROM_MATRIX.T
        out[feasible.indices[:, :, None], feasible.indices[:, None, :]] = products.swapaxes(1, 2)
        return out

    def newton_term(self, eta: Array, pull: Array) -> Array:
        """sum_i pull_i d2x_i / deta2 (p, p) for a gradient `pull` (p,) with respect to x."""
        feasible, out = self.feasible, np.zeros((len(eta), len(eta)))
        out[feasible.nonnegative, feasible.nonnegative] = pull[feasible.nonnegative] * np.exp(
            eta[feasible.nonnegative]
        )
        bodies = eta[feasible.indices]
        U, dU = _upper(bodies), _slopes(bodies)
        C = (pull[feasible.indices] @ _FROM_MATRIX).reshape(-1, 4, 4)
        C = 0.5 * (C + C.swapaxes(1, 2))  # pull . x = tr(C J)
        products = (C[:, None] @ dU).reshape(len(U), 10, 16)
        block = products @ dU.reshape(len(U), 10, 16).swapaxes(1, 2)
        single = np.einsum("bkij,bij->bk", dU, C @ U)
        # exp(a) scales all of U, so that d2U / (da deta) = dU / deta.
        block[:, 0, :] += single
        block[:, 1:, 0] += single[:, 1:]
        for k in (1, 2, 3):  # exponentials on the diagonal are their own derivatives
            block[:, k, k] += single[:, k]
        out[feasible.indices[:, :, None], feasible.indices[:, None, :]] = 2 * block
        return out


def coordinates(feasible: FeasibleSet, x0: Array) -> Coordinates:
    """Return the coordinates and eta of a strictly feasible x0 (p,)."""
    eta = x0.copy()
    eta[feasible.nonnegative] = np.log(x0[feasible.nonnegative])
    # J = U U' with upper U: the lower Cholesky factor with rows and columns in reverse.
    products = feasible.pseudo_inertia(x0)[:, ::-1, ::-1]
    U = np.linalg.cholesky(products)[:, ::-1, ::-1]
    last = U[:, 3, 3]
    diagonal = np.einsum("bii->bi", U)[:, :3]
    off = np.stack([U[:, i, j] for i, j in _OFF_DIAGONAL], axis=1)
    eta[feasible.indices] = np.hstack(
        [np.log(last)[:, None], np.log(diagonal / last[:, None]), off / last[:, None]]
    )
    return Coordinates(feasible, eta)


def newton_fit(
    rows: Array, origin: Array, chart: Coordinates, eta: Array, weight: float, iterations: int
) -> tuple[Array, int, float]:
    """Minimise |u|^2 / 2 + weight |eta - eta0|^2 / 2, u (r,) = rows (x(eta) - origin), from eta;
    return (eta, iterations, decrement).

    Levenberg damping with the second derivatives of x: Gauss-Newton, without them, converges slowly
    along the curved valley of exact data. Raises EstimationError where it does not converge.
    """
    objective = _Objective(rows, origin, chart, weight)
    damping, value = 1e-3, objective.value(eta)
    for iteration in range(1, iterations + 1):
        step = objective.step(eta, value, damping)
        if step.final is not None:
            return eta, iteration, step.final
        eta, value, damping = step.eta, step.value, step.damping / 16.0
    raise EstimationError(
        f"Log-Cholesky least squares did not converge in {iterations} iterations; allow more, or "
        "increase the weight of the prior."
    )


@dataclass(frozen=True, eq=False)
class _Step:
    """An accepted step; `final` is the Newton decrement where the iteration has converged."""

    eta: Array
    value: float
    damping: float
    final: float | None = None


@dataclass(frozen=True, eq=False)
class _Objective:
    """Weighted squares of rows (x(eta) - origin), plus the distance from eta0."""

    rows: Array
    origin: Array
    chart: Coordinates
    weight: float

    def value(self, eta: Array) -> float:
        """Objective; infinite where the exponentials overflow."""
        with np.errstate(over="ignore", invalid="ignore"):
            u = self.rows @ (self.chart.x(eta) - self.origin)
            value = 0.5 * float(u @ u)
            value += 0.5 * self.weight * float(np.sum((eta - self.chart.eta0) ** 2))
        return value if np.isfinite(value) else np.inf

    def step(self, eta: Array, value: float, damping: float) -> _Step:
        """The first step, of growing damping, that reduces the objective."""
        u, J = self.rows @ (self.chart.x(eta) - self.origin), self.rows @ self.chart.jacobian(eta)
        gradient = J.T @ u + self.weight * (eta - self.chart.eta0)
        # Without the curvature of x the matrix is positive definite: its diagonal sets the scale.
        hessian = J.T @ J + self.weight * np.eye(len(eta))
        size = 1 / np.sqrt(np.diag(hessian))
        exact = hessian + self.chart.newton_term(eta, self.rows.T @ u)
        while damping <= 1e12:
            solve = _solver(exact, size, damping)
            if solve is not None:
                step = solve(gradient)
                decrement = float(gradient @ step)
                if decrement <= CONVERGED * self.weight:
                    return _Step(eta, value, damping, decrement)
                further = eta - step
                # Second-order correction: the curvature that the step misses is removed first.
                with np.errstate(over="ignore", invalid="ignore"):
                    missed = self.rows @ (self.chart.x(further) - self.origin) - (u - J @ step)
                if np.isfinite(missed).all():
                    further = further - solve(J.T @ missed)
                    new = self.value(further)
                    if new < value:
                        return _Step(further, new, damping)
            damping = max(damping, 1e-9) * 8.0
        # No step reduces the objective: the gradient is rounding error.
        return _Step(eta, value, damping, float(np.sum((gradient * size) ** 2)))


def _solver(hessian: Array, size: Array, damping: float) -> Callable[[Array], Array] | None:
    """g -> (H + damping diag)^-1 g, or None where that is not positive definite."""
    scaled = hessian * size * size[:, None]
    # Damping on a unit diagonal is relative (Marquardt): logarithms of masses and products of
    # inertia have unlike curvature.
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
    for k, (i, j) in enumerate(_OFF_DIAGONAL):
        U[:, i, j] = bodies[:, 4 + k]
    return np.asarray(np.exp(bodies[:, 0])[:, None, None] * U)


def _slopes(bodies: Array) -> Array:
    """dU / deta (nb, 10, 4, 4)."""
    U, dU = _upper(bodies), np.zeros((len(bodies), 10, 4, 4))
    dU[:, 0] = U
    for k in range(3):
        dU[:, 1 + k, k, k] = U[:, k, k]
    for k, (i, j) in enumerate(_OFF_DIAGONAL):
        dU[:, 4 + k, i, j] = np.exp(bodies[:, 0])
    return dU
