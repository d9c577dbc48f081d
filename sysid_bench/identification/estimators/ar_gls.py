"""Generalised least squares with autoregressive noise: rows are whitened in time."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.normal_qr import stacked_factor
from sysid_bench.identification.linear.residual import (
    blocks_of_samples,
    has_converged,
    step,
    torque_residual,
)
from sysid_bench.identification.linear.weights import weighted_fit, with_floor
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class ARGLS:
    """Least squares on rows whitened by an AR model of each joint's noise.

    e_t = -a_1 e_(t-1) - ... - a_order e_(t-order) + w_t; the coefficients come from the residuals
    (Yule-Walker equations), then beta from the whitened rows, repeated until a step changes the
    torques by less than 1e-10 of them. The first `order` samples are dropped (Cochrane and Orcutt
    1949). Order 4 models two resonances; of 50 iterations the problems of the conformance kit take
    16. Assumes W exact and samples in the order of time at a steady rate.
    """

    order: int = 4
    iterations: int = 50

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and the covariance of the whitened rows.

        Raises EstimationError where the recording is too short or does not excite every direction,
        or where the iteration does not converge.
        """
        if problem.samples <= 4 * self.order:
            raise EstimationError(
                f"{problem.samples} samples are too few for noise of order {self.order}; record a "
                "longer motion, or use the method 'wls'."
            )
        beta, _, _ = weighted_fit(problem)
        # Columns of each row and coefficients of its filter are estimated from its samples.
        acting = np.array([len(factor.columns) for factor in problem.factors])
        freedom = np.maximum(problem.samples - 2 * self.order - acting, 1)
        for iteration in range(1, self.iterations + 1):
            residual = torque_residual(problem, beta)
            taps = np.array([_whitening_filter(column, self.order) for column in residual.T])
            white = _filtered(residual, taps)
            sigma = with_floor(problem, np.sqrt((white**2).sum(axis=0) / freedom))
            R = stacked_factor(problem, (1.0 / sigma).tolist())[:-1, :-1]
            change, spread = step(R, _whitened(problem, residual, taps / sigma[:, None]))
            beta = beta + change
            if has_converged(R, change, beta):
                poles = [float(np.abs(np.roots(tap)).max(initial=0.0)) for tap in taps]
                stats = {"iterations": float(iteration), "largest_pole": max(poles)}
                return Estimate(beta, covariance=spread @ spread.T, stats=stats)
        raise EstimationError(
            f"The method did not converge in {self.iterations} iterations; allow more, or use the "
            "method 'wls'."
        )


def _whitening_filter(noise: Array, order: int) -> Array:
    """Filter [1, a_1, ..., a_order] that whitens a series (N,), by the Yule-Walker equations."""
    # Biased autocorrelations (divided by N, not N - k): the model is always stable.
    lags = np.array([noise[k:] @ noise[: len(noise) - k] for k in range(order + 1)])
    if order == 0 or lags[0] == 0.0:
        return np.concatenate([[1.0], np.zeros(order)])
    return np.concatenate([[1.0], solve_toeplitz(lags[:-1], -lags[1:])])


def _whitened(problem: Problem, residual: Array, taps: Array) -> Iterator[tuple[Array, Array]]:
    """Rows and residuals filtered in time, block by block, without the first `order` samples."""
    order = taps.shape[1] - 1
    past = np.zeros((0, *(len(problem.rows), problem.base.rank))), residual[:0]
    for Y, rest in blocks_of_samples(problem, residual):
        Y, rest = np.concatenate([past[0], Y]), np.concatenate([past[1], rest])
        if len(Y) > order:
            yield _filtered(Y, taps[..., None]), _filtered(rest, taps)
        # -order as start would keep everything for order 0.
        past = Y[len(Y) - min(order, len(Y)) :], rest[len(Y) - min(order, len(Y)) :]


def _filtered(values: Array, taps: Array) -> Array:
    """sum_k taps_k (rows, order + 1, ...) values_(t - k) (N, rows, ...): (N - order, rows, ...)."""
    order = taps.shape[1] - 1
    count = len(values) - order
    return np.asarray(
        sum(taps[:, k] * values[order - k : order - k + count] for k in range(order + 1))
    )
