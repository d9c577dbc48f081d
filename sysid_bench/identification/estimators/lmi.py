"""Least squares under linear matrix inequalities of physical consistency."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.identification.feasibility.feasible_prior import start_of
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, estimate_of, fit
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class LMI:
    """min |S^-1/2 (W K theta - b)|^2 with pseudo-inertias J_i >= margin tr(J_i) 1, S as in `wls`.

    Friction and rotor inertia are non-negative (`Problem.signed`); masses (kg) and centres of mass
    (m from the body frame) lie within limits. A semidefinite program, solved by Clarabel;
    `duality_gap` and `roundness` (smallest eigenvalue of any J over its trace) are the certificate.
    Unobservable parameters come from the prior, else from spheres of 1 kg, and mean nothing by
    themselves. margin = 1e-7 exceeds Clarabel's tolerance. Sousa and Cortesao (2014, 2019);
    Wensing, Kim, Slotine (2018).
    """

    margin: float = 1e-7
    mass: tuple[float, float] = (0.0, np.inf)
    com: float = field(default=np.inf, metadata={"unit": "m"})

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction; raises
        EstimationError where Clarabel does not solve the program."""
        feasible = feasible_set_of(problem)
        limits = Limits(self.margin, (self.mass[0], self.mass[1]), self.com)
        return estimate_of(
            feasible, fit(feasible, problem, limits, start_of(feasible, problem.prior))
        )
