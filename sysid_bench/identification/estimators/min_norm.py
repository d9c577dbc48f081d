"""Minimum-norm least squares: the pseudoinverse on all parameters."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinv

from sysid_bench.identification.linear.least_squares import residual_norm, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class MinNorm:
    """theta = Y^+ tau on all p parameters, singular values below `rcond` of the largest dropped.

    Among all theta with minimal residual it returns the one of smallest norm in SI numbers:
    unobservable parameters become zero, or a share of a sum, and the residual does not show it.
    Only parameters with the verdict "identifiable" have a meaning. rcond = 1e-10 lies between
    rounding and weak excitation. Covariance s^2 (Y'Y)^+ on the base parameters. Closed form.
    Assumes Y exact, torque noise white and equal on all rows. Penrose (1955).
    """

    rcond: float = 1e-10

    def solve(self, problem: Problem) -> Estimate:
        """Return theta and the covariance of beta, also for a rank-deficient regressor."""
        base = problem.base
        R = stacked_factor(problem)
        # Y = W K and R is the factor of [W | tau]: R K has the singular values of Y.
        inverse = pinv(R[:-1, :-1] @ base.K, rtol=self.rcond)
        theta = inverse @ R[:-1, -1]
        freedom = sum(f.samples for f in problem.factors if len(f.columns)) - base.rank
        squares = float((residual_norm(problem, base.K @ theta) ** 2).sum())
        spread = np.sqrt(squares / max(freedom, 1)) * base.K @ inverse
        return Estimate(theta=theta, covariance=spread @ spread.T)
