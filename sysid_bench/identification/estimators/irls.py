"""Iteratively reweighted least squares with the full covariance of the noise across joints."""

from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np
from scipy.special import chdtr, chdtri

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.m_estimation import robust_scales
from sysid_bench.identification.linear.residuals import at_rest, outlier_weights, residuals, step
from sysid_bench.identification.linear.weights import weighted_fit, with_floor
from sysid_bench.types import Array, Estimate, Problem

SETTLED = 10
"""Iterations after which it is held which samples count: one on the edge would flip forever."""


@dataclass(frozen=True)
class IRLS:
    """Samples whitened by the covariance Lambda (rows, rows) of their residuals across joints,
    Lambda from the new residuals, until beta rests. Samples further out than `cut` standard
    deviations would be in one dimension, by their chi-square, do not count.

    Lambda is divided by the share of the variance that Gaussian noise keeps, and has sqrt((N - b_i)
    (N - b_j)) degrees of freedom, b_j base parameters on joint j. Covariance of beta by the
    whitened rows. Han, Wu, Liu, Xiong (2020). Assumes W exact and noise white in time.
    """

    cut: float = 3.0
    iterations: int = 100

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction or
        beta does not come to rest."""
        beta, weighted, _ = weighted_fit(problem)
        R = weighted[:-1, :-1]
        felt = np.array([len(factor.columns) > 0 for factor in problem.factors])
        farthest, share = _within(self.cut, int(felt.sum()))
        whiten = np.diag(1 / robust_scales(problem, residuals(problem, beta))[felt])
        for iteration in range(1, self.iterations + 1):
            residual = residuals(problem, beta)[:, felt]
            if iteration <= SETTLED:
                counted = ((residual @ whiten.T) ** 2).sum(axis=1) <= farthest
            whiten = _whitening(problem, felt, residual * counted[:, None] / np.sqrt(share))
            blocks = (
                ((whiten @ Y[:, felt]) * kept[:, None, None], rest * kept[:, None])
                for Y, rest, kept in outlier_weights(problem, residual @ whiten.T, counted)
            )
            change, spread = step(R, blocks)
            beta = beta + change
            if iteration > SETTLED and at_rest(R, change, beta):
                left = float(len(counted) - counted.sum())
                stats = {"iterations": float(iteration), "left_out": left}
                return Estimate(beta, covariance=spread @ spread.T, stats=stats)
        raise EstimationError(
            f"beta did not come to rest in {self.iterations} iterations; allow more, or take the "
            "method 'wls'."
        )


def _whitening(problem: Problem, felt: Array, residual: Array) -> Array:
    """C^-1/2 D^-1 (k, k) of the covariance D C D of residuals (N, k), D their deviations: symmetric
    in C, so that joints are alike. Above rounding, since exact data leave a covariance of nothing.
    """
    acting = np.array([len(factor.columns) for factor in problem.factors])[felt]
    freedom = np.maximum(np.count_nonzero(residual.any(axis=1)) - acting, 1.0)
    floor = with_floor(problem, np.zeros(len(problem.factors)))[felt]
    deviations = np.sqrt((residual**2).sum(axis=0) / freedom + floor**2)
    scaled = residual / np.sqrt(freedom) / deviations
    values, axes = np.linalg.eigh(scaled.T @ scaled + np.diag((floor / deviations) ** 2))
    return np.asarray((axes / np.sqrt(np.maximum(values, 1e-12))) @ axes.T / deviations)


def _within(cut: float, k: int) -> tuple[float, float]:
    """The square of the length of k Gaussian numbers that is exceeded as often as `cut` by one of
    them, and the share of their variance that is left within."""
    farthest = float(chdtri(k, erfc(cut / sqrt(2)))) if cut < 30 else np.inf
    if farthest == np.inf:
        return np.inf, 1.0
    return farthest, float(chdtr(k + 2, farthest) / chdtr(k, farthest))
