"""Physically consistent fit with the log-det divergence from the prior."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.identification.feasibility.divergence import divergence, newton
from sysid_bench.identification.feasibility.feasible_prior import (
    feasible_point,
    find_prior,
    spread_of,
)
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.linear.base_coordinates import scaled_coordinates
from sysid_bench.identification.linear.cross_validation import check_weight, with_weight
from sysid_bench.identification.linear.least_squares import RESIDUALS, check_weights
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Entropic:
    """min |S^-1/2 (W K theta - b)|^2 / 2 + weight sum_i d(J_i, J0_i), S as in `wls`, or with
    `weights` "rms-torque" or "max-torque" that torque of each joint times one common share.

    d is the log-det (Bregman) divergence of pseudo-inertias: invariant to frames and units, and
    infinite where a body is not physically consistent. Solved by a primal-dual interior-point
    method (divergence.py) to a Newton decrement of 1e-10 weight. With the default weight 1 the
    prior counts like one sample; "cross-validated" chooses it (weight_selection.py). Assumes W
    exact and white noise per joint. Lee and Park (2018); Lee, Wensing, Park (2020).
    """

    weight: float | str = 1.0
    weights: str = RESIDUALS
    bias: ClassVar[str] = (
        "drawn towards the prior; torques are taken to have 0.001 % of noise at least"
    )

    def __post_init__(self) -> None:
        """Raise UsageError for unknown weights."""
        check_weight(self.weight)
        check_weights(self.weights)

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction.

        Raises EstimationError without a prior, or where the iteration does not converge."""
        return with_weight(self._fit, problem, self.weight)

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, prior = feasible_set_of(problem), find_prior(problem)
        std = spread_of(feasible, prior)
        x0 = feasible_point(feasible, prior.theta / feasible.scale, std)
        coordinates = scaled_coordinates(feasible, problem, x0, self.weights)
        x, iterations, decrement = newton(
            divergence(feasible, x0, std), coordinates, weight, coordinates.y(x0)
        )
        stats = {
            "iterations": float(iterations),
            "decrement": decrement,
            "roundness": float(feasible.relative_margins(x).min(initial=0.25)),
        }
        return Estimate(theta=feasible.scale * x, stats=stats)
