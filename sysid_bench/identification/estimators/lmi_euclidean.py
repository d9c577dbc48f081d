"""The feasible fit drawn towards the prior in units of its standard deviations."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, estimate_of, fit
from sysid_bench.identification.feasibility.required_prior import required_prior, spread_of
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class LMIEuclidean:
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 where every body can exist
    (as `lmi`): the a-priori method under matrix inequalities. Parameters count by their declared
    standard deviations; a plain norm would mix kg with kg m^2. Lee, Wensing, Park (2020)."""

    weight: float = 1.0
    margin: float = 1e-7
    bias: ClassVar[str] = "drawn towards the prior, as if torques had 0.001 % of noise at least"

    def solve(self, problem: Problem) -> Estimate:
        """The estimate, for motions too that do not excite every direction; raises EstimationError
        without a prior, or where Clarabel does not solve it."""
        of, prior = feasible_set_of(problem), required_prior(problem)
        pull = self.weight * np.diag(1 / spread_of(of, prior) ** 2)
        return estimate_of(of, fit(of, problem, Limits(self.margin), prior.theta / of.scale, pull))
