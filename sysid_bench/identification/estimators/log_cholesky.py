"""Nonlinear least squares in coordinates that can hold nothing but bodies that exist."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.cholesky_coordinates import coordinates, damped_newton
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.required_prior import (
    feasible_point,
    required_prior,
    spread_of,
)
from sysid_bench.identification.linear.base_coordinates import weighted_coordinates
from sysid_bench.types import Estimate, Problem

STAGE = 10.0
"""By how much the weight of the rows grows from one stage to the next."""


@dataclass(frozen=True)
class LogCholesky:
    """min |S^-1/2 (W K theta(eta) - b)|^2 + weight |eta - eta0|^2 with J = U U', U upper triangular
    with exponentials on its diagonal (Rucker and Wensing 2022): ten free numbers for a body.

    By Newton's method from the prior, the rows weighing more from stage to stage: at once they
    would make a narrow curved valley. The weight keeps eta from running off along what torques do
    not tell, and from the boundary, where least squares alone never comes to rest. S is the noise
    per joint (as `wls`).
    """

    weight: float = 1.0
    iterations: int = 100  # of each stage
    bias: ClassVar[str] = "drawn towards the prior, as if torques had 0.001 % of noise at least"

    def solve(self, problem: Problem) -> Estimate:
        """The estimate, for motions too that do not excite every direction; raises EstimationError
        without a prior, or where the iteration does not come to rest."""
        of, prior = feasible_set_of(problem), required_prior(problem)
        x0 = feasible_point(of, prior.theta / of.scale, spread_of(of, prior))
        at, rows = coordinates(of, x0), weighted_coordinates(of, problem, x0)
        inverse = np.linalg.inv(rows.T)[: rows.rank]
        eta, total = at.eta0, 0
        share = 1.0 / max(float(np.linalg.norm(inverse @ (x0 - rows.origin))), 1.0)
        while True:
            eta, count, decrement = damped_newton(
                share * inverse, rows.origin, at, eta, self.weight, self.iterations
            )
            total += count
            if share == 1.0:
                break
            share = min(share * STAGE, 1.0)
        stats = {
            "iterations": float(total),
            "decrement": decrement,
            "roundness": float(of.regularity(at.x(eta)).min(initial=0.25)),
        }
        return Estimate(theta=of.scale * at.x(eta), stats=stats)
