"""Nonlinear least squares in coordinates that can hold nothing but bodies that exist."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.identification.cholesky_coordinates import coordinates, levenberg_marquardt
from sysid_bench.identification.feasible import weighted_rows
from sysid_bench.identification.physical import physical_of
from sysid_bench.identification.prior import existing, spread_of, start_of
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class LogCholesky:
    """min |S^-1/2 (W K theta(eta) - b)|^2 + weight |eta - eta0|^2 with J = U U', U upper triangular
    with exponentials on its diagonal (Rucker and Wensing 2022): ten free numbers for a body.

    By Levenberg and Marquardt with the exact Jacobian, from the prior, or from spheres of a
    kilogram. The weight keeps eta from running off along what torques do not tell, and from the
    boundary, where least squares alone never comes to rest. S is the noise per joint (as `wls`).
    """

    weight: float = 1.0
    iterations: int = 200
    bias: ClassVar[str] = "drawn towards the prior, as if every torque had 0.01 % of noise at least"

    def solve(self, problem: Problem) -> Estimate:
        """The estimate, for motions too that do not excite every direction; raises EstimationError
        where the iteration does not come to rest."""
        of, prior = physical_of(problem), problem.prior
        x0 = start_of(of, prior)
        x0 = existing(of, x0, 0.1 + 0 * x0 if prior is None else spread_of(of, prior))
        at = coordinates(of, x0)
        A, z = weighted_rows(problem, of)
        x, iterations, decrement = levenberg_marquardt(A, z, at, self.weight, self.iterations)
        stats = {
            "iterations": float(iterations),
            "decrement": decrement,
            "roundness": float(of.roundness(x).min(initial=0.25)),
        }
        return Estimate(theta=of.scale * x, stats=stats)
