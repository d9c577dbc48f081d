"""Iteratively reweighted least squares with the full covariance of the noise across joints."""

from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from sysid_bench.errors import EstimationError
from sysid_bench.identification.rows import at_rest, beside, residuals, step
from sysid_bench.identification.weights import floored, weighted_fit
from sysid_bench.types import Array, Estimate, Problem

SETTLED = 10
"""Iterations after which it is held which samples count: one on the edge would flip forever."""


@dataclass(frozen=True)
class IRLS:
    """Samples whitened by the covariance Lambda (rows, rows) of their residuals, entries beyond
    `cut` standard deviations left out, Lambda from the new residuals, until beta rests.

    Lambda is divided by the share that Gaussian noise keeps within the cut, and has sqrt((N - b_i)
    (N - b_j)) degrees of freedom, b_j base parameters on joint j. Covariance of beta by the
    whitened rows. Han, Wu, Liu, Xiong (2020). Assumes W exact and noise white in time.
    """

    cut: float = 3.0
    iterations: int = 100

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction or
        beta does not come to rest."""
        beta, weighted, sigma = weighted_fit(problem)
        R = weighted[:-1, :-1]
        felt = np.array([len(factor.columns) > 0 for factor in problem.factors])
        lower = np.diag(sigma[felt])
        counted = np.ones((problem.samples, len(lower)))
        for iteration in range(1, self.iterations + 1):
            residual = residuals(problem, beta)[:, felt]
            white = _whitened(lower, residual)
            if iteration <= SETTLED:
                counted = (np.abs(white) <= self.cut).astype(float)
            lower = self._covariance_factor(problem, felt, lower, white * counted)
            whiten = solve_triangular(lower, np.eye(len(lower)), lower=True)
            blocks = (
                ((whiten @ Y[:, felt]) * kept[..., None], rest * kept)
                for Y, rest, kept in beside(problem, _whitened(lower, residual), counted)
            )
            change, spread = step(R, blocks)
            beta = beta + change
            if iteration > SETTLED and at_rest(R, change, beta):
                left = float(counted.size - counted.sum())
                stats = {"iterations": float(iteration), "left_out": left}
                return Estimate(beta, covariance=spread @ spread.T, stats=stats)
        raise EstimationError(
            f"beta did not come to rest in {self.iterations} iterations; allow more, or take the "
            "method 'wls'."
        )

    def _covariance_factor(
        self, problem: Problem, felt: Array, lower: Array, white: Array
    ) -> Array:
        """L (k, k) of the covariance L L' of the k rows that feel parameters, from residuals (N, k)
        that the last L has whitened; with a floor, since exact data leave a covariance of nothing.
        """
        acting = np.array([len(factor.columns) for factor in problem.factors])[felt]
        freedom = np.maximum(problem.samples - acting, 1.0) * _kept_share(self.cut)
        scaled = (white / np.sqrt(freedom)) @ lower.T
        floor = floored(problem, np.zeros(len(problem.factors)))[felt]
        return np.asarray(cholesky(scaled.T @ scaled + np.diag(floor**2), lower=True))


def _whitened(lower: Array, residual: Array) -> Array:
    """Residuals (N, k) of unit covariance."""
    return np.asarray(solve_triangular(lower, residual.T, lower=True).T)


def _kept_share(cut: float) -> float:
    """The variance of Gaussian noise cut at `cut` standard deviations, as a share of all of it."""
    density = exp(-0.5 * cut * cut) / sqrt(2 * pi)
    return 1.0 - 2 * cut * density / erf(cut / sqrt(2))
