"""The shortest theta that explains the torques: the pseudoinverse on all parameters."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinv

from sysid_bench.identification.linear.normal_qr import residual_norms, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class MinNorm:
    """theta = pinv(Y) tau, all p parameters, singular values below `rcond` of the largest dropped.

    Of everything that explains the torques it takes the shortest vector of SI numbers: what no
    motion tells comes out as zero or as a share of a sum, and the residual cannot show it. Only
    parameters with the verdict "identifiable" mean anything. Covariance s^2 (Y'Y)^+ on the base
    parameters. Penrose (1955); assumes Y exact and torque noise white and equal on all rows.
    """

    rcond: float = 1e-10

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; with a rank-deficient Y too, which it does not complain about."""
        base = problem.base
        R = stacked_factor(problem)
        # Y = W K and R is the factor of [W | tau]: R K has the singular values of Y.
        inverse = pinv(R[:-1, :-1] @ base.K, rtol=self.rcond)
        theta = inverse @ R[:-1, -1]
        freedom = sum(f.samples for f in problem.factors if len(f.columns)) - base.rank
        squares = float((residual_norms(problem, base.K @ theta) ** 2).sum())
        spread = np.sqrt(squares / max(freedom, 1)) * base.K @ inverse
        return Estimate(theta=theta, covariance=spread @ spread.T)
