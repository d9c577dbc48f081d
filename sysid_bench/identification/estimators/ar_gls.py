"""Generalised least squares with autoregressive noise: rows are whitened in time."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz, solve_triangular

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.least_squares import with_floor
from sysid_bench.identification.linear.raw_problem import raw_problem
from sysid_bench.identification.linear.reweighted_rows import (
    SETTLED,
    ScaledRows,
    has_converged,
    information_factor,
    is_update,
    scaled_rows,
    solve_step,
)
from sysid_bench.types import Array, Estimate, Experiment, Problem


@dataclass(frozen=True)
class ArGls:
    """Least squares on rows whitened by an AR model of each joint's noise.

    e_t = -a_1 e_(t-1) - ... - a_order e_(t-order) + w_t; the coefficients come from the residuals
    (Yule-Walker equations), then beta from the whitened rows, repeated until a step changes the
    torques by less than 1e-10 of them, at most 50 times (the problems of the conformance kit take
    16). The first `order` samples are dropped (Cochrane and Orcutt 1949).

    Where an experiment is given, b is the raw measured torque: a zero-phase filter leaves residuals
    without power beyond its cut-off, which no AR model of low order describes. Without one, or with
    several motions, b is that of the problem, and the residuals must not have been filtered. Order
    4 models two resonances. Assumes W exact and samples in the order of time at a steady rate: with
    encoder noise the errors of the filtered motion are part of the residuals, and whitening weighs
    them up, so that suites do not rank it. The raw torque has all samples, since whitening needs a
    steady rate: those at standstill, which the default pipeline leaves out of other fits, count.
    """

    order: int = 4
    iterations: int = 50

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the estimate of `solve` from raw torques along the measured motion."""
        return self.solve(raw_problem(experiment))

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and the covariance of the whitened rows.

        Raises EstimationError where the recording is too short or does not excite every direction.
        """
        if problem.samples <= 4 * self.order:
            raise EstimationError(
                f"{problem.samples} samples are too few for noise of order {self.order}; record a "
                "longer motion, or use the method 'wls'."
            )
        rows, beta = scaled_rows(problem)
        gamma, root, converged = rows.R @ beta, rows.R, False
        # Columns of each row and coefficients of its filter are estimated from its samples.
        acting = np.array([len(factor.columns) for factor in problem.factors])
        freedom = np.maximum(problem.samples - 2 * self.order - acting, 1)
        for iteration in range(1, self.iterations + 1):
            residual = rows.residual(gamma)
            taps = np.array([_whitening_filter(column, self.order) for column in residual.T])
            white = _filtered(residual, taps)
            sigma = with_floor(problem, np.sqrt((white**2).sum(axis=0) / freedom))
            if is_update(iteration):
                root = information_factor(_whitened(rows, taps / sigma[:, None]))
            change = solve_step(root, rows.gradient(_adjoint(white / sigma**2, taps)))
            gamma = gamma + change
            converged = has_converged(change, gamma)
            if converged:
                break
        root = information_factor(_whitened(rows, taps / sigma[:, None]))
        poles = [float(np.abs(np.roots(tap)).max(initial=0.0)) for tap in taps]
        return Estimate(
            solve_triangular(rows.R, gamma),
            covariance=rows.covariance(root),
            stats={"largest_pole": max(poles)},
            converged=converged,
            iterations=iteration,
            stop=SETTLED if converged else f"the limit of {iteration} iterations",
        )


def _whitening_filter(noise: Array, order: int) -> Array:
    """Filter [1, a_1, ..., a_order] that whitens a series (N,), by the Yule-Walker equations."""
    # Biased autocorrelations (divided by N, not N - k): the model is always stable.
    lags = np.array([noise[k:] @ noise[: len(noise) - k] for k in range(order + 1)])
    if order == 0 or lags[0] == 0.0:
        return np.concatenate([[1.0], np.zeros(order)])
    return np.concatenate([[1.0], solve_toeplitz(lags[:-1], -lags[1:])])


def _whitened(rows: ScaledRows, taps: Array) -> Iterator[Array]:
    """Scaled samples filtered in time, block by block, without the first `order` of them."""
    order = taps.shape[1] - 1
    past: Array | None = None
    for Q, _ in rows.blocks():
        Q = Q if past is None else np.concatenate([past, Q])
        if len(Q) > order:
            yield _filtered(Q, taps[..., None])
        # -order as start would keep everything for order 0.
        past = Q[len(Q) - min(order, len(Q)) :]


def _adjoint(white: Array, taps: Array) -> Array:
    """Values v (N, rows) for which v'x = white' filtered(x): the filter backwards in time."""
    order = taps.shape[1] - 1
    values = np.zeros((len(white) + order, white.shape[1]))
    for k in range(order + 1):
        values[order - k : order - k + len(white)] += taps[:, k] * white
    return values


def _filtered(values: Array, taps: Array) -> Array:
    """sum_k taps_k (rows, order + 1, ...) values_(t - k) (N, rows, ...): (N - order, rows, ...)."""
    order = taps.shape[1] - 1
    count = len(values) - order
    return np.asarray(
        sum(taps[:, k] * values[order - k : order - k + count] for k in range(order + 1))
    )
