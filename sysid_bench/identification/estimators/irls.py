"""Iteratively reweighted least squares with the noise covariance across joints."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtr, chdtri

from sysid_bench.identification.linear.least_squares import with_floor
from sysid_bench.identification.linear.reweighted_rows import (
    SETTLED,
    ScaledRows,
    has_converged,
    information_factor,
    is_update,
    row_scale,
    scaled_rows,
    solve_step,
)
from sysid_bench.types import Array, Estimate, Problem

HOLD_AFTER = 10
"""Iterations after which the set of rejected samples is held: it could alternate forever."""


@dataclass(frozen=True)
class IRLS:
    """Samples whitened by the covariance Lambda (rows, rows) of their residuals across joints.

    Lambda is updated from the residuals until a step changes the torques by less than 1e-10 of
    them. Samples whose chi-square is as improbable as `cut` standard deviations of one variable are
    rejected (3: one of 370); Lambda is corrected for the variance that rejection removes, with
    sqrt((N - b_i)(N - b_j)) degrees of freedom, b_j base parameters on joint j. Assumes W exact and
    noise white in time. Han, Wu, Liu, Xiong (2020).
    """

    cut: float = 3.0
    iterations: int = 100

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and the covariance of the whitened rows; raises EstimationError where the
        motion does not excite every direction."""
        rows, beta = scaled_rows(problem)
        # Joints that no parameter acts on have no residual to whiten.
        felt = np.array([len(factor.columns) > 0 for factor in problem.factors])
        farthest, share = _within(self.cut, int(felt.sum()))
        gamma, root, converged = rows.R @ beta, rows.R, False
        whiten = np.diag(1 / row_scale(problem, rows.residual(gamma))[felt])
        for iteration in range(1, self.iterations + 1):
            residual = rows.residual(gamma)[:, felt]
            if iteration <= HOLD_AFTER:
                counted = ((residual @ whiten.T) ** 2).sum(axis=1) <= farthest
            whiten = _whitening(problem, felt, residual * counted[:, None] / np.sqrt(share))
            if is_update(iteration):
                root = information_factor(_whitened(rows, whiten, felt, counted))
            weighted = np.zeros((len(residual), len(felt)))
            weighted[:, felt] = (residual @ whiten.T @ whiten) * counted[:, None]
            change = solve_step(root, rows.gradient(weighted))
            gamma = gamma + change
            converged = iteration > HOLD_AFTER and has_converged(change, gamma)
            if converged:
                break
        root = information_factor(_whitened(rows, whiten, felt, counted))
        return Estimate(
            solve_triangular(rows.R, gamma),
            covariance=rows.covariance(root),
            stats={"left_out": float(len(counted) - counted.sum())},
            converged=converged,
            iterations=iteration,
            stop=SETTLED if converged else f"the limit of {iteration} iterations",
        )


def _whitened(rows: ScaledRows, whiten: Array, felt: Array, counted: Array) -> Iterator[Array]:
    """Blocks of scaled samples, whitened across joints, without the rejected samples."""
    return (whiten @ Q[kept][:, felt] for Q, kept in rows.samples(counted))


def _whitening(problem: Problem, felt: Array, residual: Array) -> Array:
    """C^-1/2 D^-1 (k, k) of the covariance D C D of residuals (N, k), D their standard deviations.

    The symmetric root treats all joints alike; a floor above rounding keeps the covariance of exact
    data regular.
    """
    acting = np.array([len(factor.columns) for factor in problem.factors])[felt]
    freedom = np.maximum(np.count_nonzero(residual.any(axis=1)) - acting, 1.0)
    floor = with_floor(problem, np.zeros(len(problem.factors)))[felt]
    deviations = np.sqrt((residual**2).sum(axis=0) / freedom + floor**2)
    scaled = residual / np.sqrt(freedom) / deviations
    values, axes = np.linalg.eigh(scaled.T @ scaled + np.diag((floor / deviations) ** 2))
    return np.asarray((axes / np.sqrt(np.maximum(values, 1e-12))) @ axes.T / deviations)


def _within(cut: float, k: int) -> tuple[float, float]:
    """Chi-square threshold of k Gaussian variables that is exceeded as often as `cut` by one of
    them, and the share of their variance within it."""
    farthest = float(chdtri(k, erfc(cut / sqrt(2)))) if cut < 30 else np.inf
    if farthest == np.inf:
        return np.inf, 1.0
    return farthest, float(chdtr(k + 2, farthest) / chdtr(k, farthest))
