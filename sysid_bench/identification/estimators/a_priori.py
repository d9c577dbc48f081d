"""Bayesian least squares: a Gaussian prior on all parameters."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.feasible_prior import find_prior
from sysid_bench.identification.linear.cross_validation import check_weight, with_weight
from sysid_bench.identification.linear.least_squares import row_noise, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class APriori:
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 over all p parameters.

    theta0 and std are mean and standard deviations of the prior, so that no unit is favoured; S is
    the noise variance per joint (as `wls`). Closed form by SVD. The default weight 1 gives the
    maximum a posteriori estimate, and the covariance of its posterior; "cross-validated" chooses
    the weight (weight_selection.py). Physical consistency is not imposed. Assumes W exact and white
    noise per joint. Tarantola (2005).
    """

    weight: float | str = 1.0
    bias: ClassVar[str] = "drawn towards the prior, less so the more exact the data are"

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is neither positive nor the word for tuning."""
        check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return theta and the covariance, also where the motion does not excite every direction.

        Raises EstimationError without a prior."""
        return with_weight(self._fit, problem, self.weight)

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        prior = find_prior(problem)
        K, std = problem.base.K, prior.std / np.sqrt(weight)
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        # In x = (theta - theta0) / std the prior is the unit ball, and the data a rank-r map of it.
        U, values, Vt = np.linalg.svd(R[:, :-1] @ (K * std), full_matrices=False)
        projected = U.T @ (R[:, -1] - R[:, :-1] @ (K @ prior.theta))
        theta = prior.theta + std * (Vt.T @ (values / (values**2 + 1.0) * projected))
        excited = (K * std) @ Vt.T
        unexcited = K * std - excited @ Vt
        root = np.hstack([excited / np.sqrt(values**2 + 1.0), unexcited])
        return Estimate(theta=theta, covariance=root @ root.T)
