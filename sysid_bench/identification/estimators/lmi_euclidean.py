"""Physically consistent fit with a weighted Euclidean distance to the prior."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.feasible_prior import find_prior, spread_of
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, estimate_of, fit
from sysid_bench.identification.linear.cross_validation import check_weight, with_weight
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class LMIEuclidean:
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 under the LMIs of `lmi`.

    Parameters are scaled by the standard deviations of the prior: a plain norm would add kg to kg
    m^2. With the default weight 1 it is the maximum a posteriori estimate within the constraints;
    "cross-validated" chooses the weight (weight_selection.py). Solved by Clarabel to a duality gap
    of 1e-7; margin as in `lmi`. Assumes W exact and white noise per joint. Lee, Wensing, Park
    (2020).
    """

    weight: float | str = 1.0
    margin: float = 1e-7
    bias: ClassVar[str] = (
        "drawn towards the prior; torques are taken to have 0.001 % of noise at least"
    )

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is neither positive nor the word for tuning."""
        check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction; raises
        EstimationError without a prior, or where Clarabel does not solve the program."""
        return with_weight(self._fit, problem, self.weight)

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, prior = feasible_set_of(problem), find_prior(problem)
        pull = weight * np.diag(1 / spread_of(feasible, prior) ** 2)
        return estimate_of(
            feasible,
            fit(feasible, problem, Limits(self.margin), prior.theta / feasible.scale, pull),
        )
