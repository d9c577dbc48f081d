"""Weighted least squares: rows are weighted by the noise of their joint."""

from dataclasses import dataclass

from sysid_bench.identification.linear.least_squares import (
    RESIDUALS,
    check_weights,
    fit_noise,
    inverse_of,
    row_std,
    scaled_fit,
)
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class WLS:
    """beta = (W' S^-1 W)^-1 W' S^-1 b by QR, S = diag(sigma_j^2); covariance (W' S^-1 W)^-1.

    sigma_j comes from joint j's own least squares with N_j - b_j degrees of freedom, b_j its base
    parameters: unbiased whatever the noise of the other joints, so that one iteration suffices.
    Each further one of `iterations` uses the residuals of the weighted fit with N_j - tr(H_jj)
    degrees of freedom, H the hat matrix. `weights` "max-torque" divides each row by the largest
    torque of its joint instead, "rms-torque" by its RMS torque, with one common factor from the
    residuals: noise is then taken as the same share of each joint's torque, and `iterations` has no
    effect. Assumes W exact and white
    noise per joint. Gautier (1997); Gautier and Poignet (2001).
    """

    iterations: int = 1
    weights: str = RESIDUALS

    def __post_init__(self) -> None:
        check_weights(self.weights)

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        beta, R, sigma = self._fit(problem)
        inverse = inverse_of(R)
        return Estimate(
            beta,
            covariance=inverse @ inverse.T,
            sigma=sigma,
            stats={"sigma_ratio": float(sigma.max() / sigma.min())},
        )

    def _fit(self, problem: Problem) -> tuple[Array, Array, Array]:
        """Return beta, the factor of the weighted rows and their noise."""
        if self.weights != RESIDUALS:
            return scaled_fit(problem, row_std(problem, self.weights))
        beta, R, sigma = scaled_fit(problem)
        for _ in range(self.iterations - 1):
            beta, R, sigma = scaled_fit(problem, fit_noise(problem, beta, R, sigma))
        return beta, R, sigma
