"""Exact reconstruction: the bodies nearest to the prior that have the least-squares torques."""

from dataclasses import dataclass, replace

from sysid_bench.identification.estimators.wls import WLS
from sysid_bench.identification.feasibility.completion import complete
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.required_prior import required_prior
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Reconstruction:
    """theta = argmin d(theta, theta0) over what can exist with K theta = beta, beta that of `wls`.

    `distance`: "entropic", "euclidean" or "pullback". It changes nothing of the fit: where noise
    has carried beta out of what can exist, it says so and fails. Sousa and Cortesao (2014); Gaz,
    Flacco, De Luca (2016).
    """

    distance: str = "entropic"

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError without a prior, where the motion does not excite
        every direction, or where no body can have these base parameters."""
        prior, fit = required_prior(problem), WLS().solve(problem)
        assert fit.beta is not None
        of = feasible_set_of(problem)
        theta = complete(of, problem.base, fit.beta, prior, self.distance)
        roundness = float(of.regularity(theta / of.scale).min(initial=0.25))
        return replace(fit, theta=theta, stats={"roundness": roundness})
