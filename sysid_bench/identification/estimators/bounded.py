"""Least squares between bounds: each parameter by itself, no matrix inequality."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, fit
from sysid_bench.identification.feasibility.required_prior import start_of
from sysid_bench.identification.linear.normal_qr import require_excited, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Bounded:
    """min |S^-1/2 (W K theta - b)|^2 with masses within limits (kg), moments of inertia that are
    not negative and keep the triangle inequality, joint terms that are not negative; S is the noise
    per joint (as `wls`).

    Weaker than what can exist: products of inertia and centres of mass are free. beta alone is
    answered, since many theta within the bounds share it.
    """

    mass: tuple[float, float] = (0.0, np.inf)

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction, or
        where Clarabel does not solve it."""
        require_excited(stacked_factor(problem))
        of = feasible_set_of(problem)
        found = fit(
            of, problem, Limits(None, (self.mass[0], self.mass[1])), start_of(of, problem.prior)
        )
        stats = {"duality_gap": found.gap, "excess": found.excess}
        return Estimate(problem.base.K @ (of.scale * found.x), stats=stats)
