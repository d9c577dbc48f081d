"""The best fit that can exist: least squares under linear matrix inequalities."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, estimate_of, fit
from sysid_bench.identification.feasibility.required_prior import start_of
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class LMI:
    """min |S^-1/2 (W K theta - b)|^2 where every body has a pseudo-inertia J >= margin tr(J) 1,
    joint terms that take or store energy are not negative, and masses (kg) and centres of mass (m
    from the body's frame) lie within limits; S is the noise per joint (as `wls`).

    What the torques do not tell comes from the prior, or from spheres of a kilogram, as near as the
    constraints let it: it means nothing by itself. Where least squares can exist, its torques are
    the answer's. Sousa and Cortesao (2014, 2019); Wensing, Kim, Slotine (2018). Solved by Clarabel;
    `duality_gap` and `roundness` (smallest eigenvalue of any J over its trace) are the certificate.
    """

    margin: float = 1e-7
    mass: tuple[float, float] = (0.0, np.inf)
    com: float = field(default=np.inf, metadata={"unit": "m"})

    def solve(self, problem: Problem) -> Estimate:
        """The estimate, for motions too that do not excite every direction; raises EstimationError
        where Clarabel does not solve it."""
        of = feasible_set_of(problem)
        limits = Limits(self.margin, (self.mass[0], self.mass[1]), self.com)
        return estimate_of(of, fit(of, problem, limits, start_of(of, problem.prior)))
