"""Least squares with a prior: what the data do not say is taken from what was known."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.required_prior import required_prior
from sysid_bench.identification.linear.normal_qr import stacked_factor
from sysid_bench.identification.linear.weights import row_sigmas
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class APriori:
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 over all parameters.

    Each parameter counts by its declared standard deviation, so that no unit is favoured; S is the
    noise per joint (as `wls`). With weight 1 it is the most probable theta of a Gaussian prior, and
    the covariance that of its posterior. Physical consistency is not imposed. Assumes W exact and
    white noise per joint.
    """

    weight: float = 1.0
    bias: ClassVar[str] = "drawn towards the prior, the less the more exact the data are"

    def solve(self, problem: Problem) -> Estimate:
        """The estimate, for motions too that do not excite every direction; raises EstimationError
        without a prior."""
        prior = required_prior(problem)
        K, std = problem.base.K, prior.std / np.sqrt(self.weight)
        R = stacked_factor(problem, (1.0 / row_sigmas(problem)).tolist())
        # In x = (theta - theta0) / std the prior is the unit ball, and the data a rank-r map of it.
        U, values, Vt = np.linalg.svd(R[:, :-1] @ (K * std), full_matrices=False)
        told = U.T @ (R[:, -1] - R[:, :-1] @ (K @ prior.theta))
        theta = prior.theta + std * (Vt.T @ (values / (values**2 + 1.0) * told))
        seen = (K * std) @ Vt.T
        unseen = K * std - seen @ Vt
        spread = np.hstack([seen / np.sqrt(values**2 + 1.0), unseen])
        return Estimate(theta=theta, covariance=spread @ spread.T)
