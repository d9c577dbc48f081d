"""Null model: the prior without any data."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.feasible_prior import find_prior
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class PriorMean:
    """theta = theta0, the mean of the prior; covariance K diag(std^2) K' of the declared spread.

    The row against which a table shows what the data have added: a method that loses to it has
    made a good prior worse.
    """

    bias: ClassVar[str] = "the error of the prior, whatever the data"
    uses_data: ClassVar[bool] = False

    def solve(self, problem: Problem) -> Estimate:
        """Return the prior; raises EstimationError without one."""
        prior = find_prior(problem)
        root = problem.base.K * prior.std
        return Estimate(theta=np.array(prior.theta), covariance=root @ root.T)
