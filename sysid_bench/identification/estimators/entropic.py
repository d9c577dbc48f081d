"""The fit drawn towards the prior by the entropy of its bodies."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.identification.feasibility.bregman import divergence, newton
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.required_prior import (
    feasible_point,
    required_prior,
    spread_of,
)
from sysid_bench.identification.linear.base_coordinates import weighted_coordinates
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Entropic:
    """min |S^-1/2 (W K theta - b)|^2 / 2 + weight sum d(J_i, J0_i) with the log-det divergence d,
    by Newton's method (bregman.py); S is the noise per joint (as `wls`).

    Every body can exist by construction, and the answer does not depend on frames or units. Lee and
    Park (2018); Lee, Wensing, Park (2020).
    """

    weight: float = 1.0
    bias: ClassVar[str] = "drawn towards the prior, as if torques had 0.001 % of noise at least"

    def solve(self, problem: Problem) -> Estimate:
        """The estimate, for motions too that do not excite every direction; raises EstimationError
        without a prior, or where Newton's method does not come to rest."""
        of, prior = feasible_set_of(problem), required_prior(problem)
        std = spread_of(of, prior)
        x0 = feasible_point(of, prior.theta / of.scale, std)
        at = weighted_coordinates(of, problem, x0)
        x, iterations, decrement = newton(divergence(of, x0, std), at, self.weight, at.y(x0))
        stats = {
            "iterations": float(iterations),
            "decrement": decrement,
            "roundness": float(of.regularity(x).min(initial=0.25)),
        }
        return Estimate(theta=of.scale * x, stats=stats)
