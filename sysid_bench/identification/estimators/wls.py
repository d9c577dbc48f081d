"""Weighted least squares: each joint by its own residual."""

from dataclasses import dataclass

from sysid_bench.identification.linear.normal_qr import inverse_of
from sysid_bench.identification.linear.weights import fit_sigmas, weighted_fit
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class WLS:
    """Rows of joint j divided by sigma_j; covariance (W' S^-1 W)^-1.

    sigma_j is the residual of joint j's own least squares with N_j - b_j degrees of freedom, b_j
    base parameters that joint j tells apart: unbiased whatever the noise of other joints. Each of
    `iterations` beyond the first takes the residuals of the weighted fit instead, with
    N_j - tr(H_jj) degrees of freedom, H its hat matrix.

    Gautier (1997); Gautier and Poignet (2001). Assumes W exact and white noise per joint.
    """

    iterations: int = 1

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction."""
        beta, R, sigma = weighted_fit(problem)
        for _ in range(self.iterations - 1):
            beta, R, sigma = weighted_fit(problem, fit_sigmas(problem, beta, R, sigma))
        inverse = inverse_of(R)
        return Estimate(
            beta,
            covariance=inverse @ inverse.T,
            sigma=sigma,
            stats={"sigma_ratio": float(sigma.max() / sigma.min())},
        )
