"""Physically consistent bodies with exactly the base parameters of least squares."""

from dataclasses import dataclass, replace

from sysid_bench.identification.estimators.wls import WLS
from sysid_bench.identification.feasibility.completion import completed_parameters
from sysid_bench.identification.feasibility.feasible_prior import find_prior
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Reconstruction:
    """theta = argmin d(theta, theta0) over physically consistent theta with K theta = beta of
    `wls`.

    `distance` d: "entropic" (log-det divergence, the default, invariant to frames and units),
    "euclidean" or "pullback". The fit itself is unchanged: it fails where noise has carried beta
    out of the feasible set. Convex, with the stop rules of divergence.py and lmi_fit.py.
    Assumptions of `wls`. Sousa and Cortesao (2014); Gaz, Flacco, De Luca (2016).
    """

    distance: str = "entropic"

    def solve(self, problem: Problem) -> Estimate:
        """Return theta with the covariance of `wls`; raises EstimationError without a prior, where
        the motion does not excite every direction, or where no physically consistent body has this
        beta."""
        prior, fit = find_prior(problem), WLS().solve(problem)
        assert fit.beta is not None
        feasible = feasible_set_of(problem)
        theta = completed_parameters(feasible, problem.base, fit.beta, prior, self.distance)
        roundness = float(feasible.relative_margins(theta / feasible.scale).min(initial=0.25))
        return replace(fit, theta=theta, stats={"roundness": roundness})
