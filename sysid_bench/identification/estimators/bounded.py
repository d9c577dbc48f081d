"""Least squares with bounds on single parameters and the triangle inequality."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.identification.feasibility.feasible_prior import start_of
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, fit
from sysid_bench.identification.linear.least_squares import check_rank, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Bounded:
    """min |S^-1/2 (W K theta - b)|^2 with linear inequalities on theta; S as in `wls`.

    Masses within `mass` (kg), moments of inertia non-negative with the triangle inequality, joint
    terms non-negative: necessary for physical consistency, not sufficient, since products of
    inertia and centres of mass are free. A quadratic program, solved by Clarabel to a duality gap
    of 1e-7. Returns beta alone, since many theta within the bounds share it. The default bounds
    exclude only what no body has. Assumes W exact and white noise per joint.
    """

    mass: tuple[float, float] = (0.0, np.inf)

    def solve(self, problem: Problem) -> Estimate:
        """Return beta; raises EstimationError where the motion does not excite every direction, or
        where Clarabel does not solve the program."""
        check_rank(stacked_factor(problem))
        feasible = feasible_set_of(problem)
        solution = fit(
            feasible,
            problem,
            Limits(None, (self.mass[0], self.mass[1])),
            start_of(feasible, problem.prior),
        )
        stats = {"duality_gap": solution.gap, "excess": solution.excess}
        return Estimate(problem.base.K @ (feasible.scale * solution.x), stats=stats)
