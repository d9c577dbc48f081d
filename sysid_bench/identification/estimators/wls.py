"""Weighted least squares: each joint by its own residual."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.identification.compressed import compress, residual_norms, solve
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class WLS:
    """Rows of joint j divided by sigma_j, its OLS residual with N_j - b_j degrees of freedom, b_j
    the base parameters that act on joint j; `iterations` of it. Covariance (W' S^-1 W)^-1.

    Gautier (1997); Gautier and Poignet (2001). Assumes W exact and white noise per joint.
    """

    iterations: int = 1

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction."""
        r = problem.base.rank
        beta = solve(compress(problem))
        for _ in range(max(self.iterations, 1)):
            sigma = row_sigmas(problem, beta)
            R = compress(problem, (1.0 / sigma).tolist())
            beta = solve(R)
        inverse = solve_triangular(R[:r, :r], np.eye(r))
        return Estimate(
            beta,
            covariance=inverse @ inverse.T,
            stats={"sigma_ratio": float(sigma.max() / sigma.min())},
        )


def row_sigmas(problem: Problem, beta: Array) -> Array:
    """Standard deviation (rows,) of each row's residual.

    Residuals at rounding level carry no information about noise: a floor of 1e-10 of the row's RMS
    torque keeps exact data from being weighted by chance.
    """
    norms = residual_norms(problem, beta)
    sigma = np.empty(len(norms))
    for i, factor in enumerate(problem.factors):
        freedom = max(factor.samples - len(factor.columns), 1)
        rms = np.linalg.norm(factor.R[:, -1]) / np.sqrt(max(factor.samples, 1))
        sigma[i] = max(norms[i] / np.sqrt(freedom), 1e-10 * rms)
    # A row without torque or columns weighs nothing; any positive number serves.
    return np.where(sigma > 0, sigma, sigma.max() if sigma.any() else 1.0)
