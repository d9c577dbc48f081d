"""Ordinary least squares on the base parameters."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.identification.linear.least_squares import residual_norm, solve, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class OLS:
    """beta = (W'W)^-1 W'b by QR; covariance s^2 (W'W)^-1, s^2 = |b - W beta|^2 / (M - r).

    Closed form, no settings. Assumes W exact, torque noise white and equal on all rows; physical
    consistency is not imposed. Atkeson, An, Hollerbach (1986); Gautier and Khalil (1990)."""

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        R = stacked_factor(problem)
        r = problem.base.rank
        beta = solve(R)
        freedom = sum(factor.samples for factor in problem.factors if len(factor.columns)) - r
        squares = float((residual_norm(problem, beta) ** 2).sum())
        inverse = solve_triangular(R[:r, :r], np.eye(r))
        variance = squares / max(freedom, 1)
        sigma = np.ones(len(problem.rows))
        return Estimate(beta, covariance=variance * inverse @ inverse.T, sigma=sigma)
