"""Nonlinear least squares in log-Cholesky coordinates of the pseudo-inertias."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.cholesky_coordinates import coordinates, newton_fit
from sysid_bench.identification.feasibility.feasible_prior import (
    feasible_point,
    find_prior,
    spread_of,
)
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.linear.base_coordinates import scaled_coordinates
from sysid_bench.identification.linear.cross_validation import check_weight, with_weight
from sysid_bench.types import Estimate, Problem

STAGE = 10.0
"""Growth of the weight of the rows from one stage to the next."""


@dataclass(frozen=True)
class LogCholesky:
    """min |S^-1/2 (W K theta(eta) - b)|^2 + weight |eta - eta0|^2, S as in `wls`.

    J = U U', U upper triangular with exponentials on its diagonal: ten unconstrained numbers per
    body, all of them physically consistent (Rucker and Wensing 2022). Damped Newton from the prior,
    the weight of the rows growing tenfold from stage to stage: at once they form a narrow curved
    valley. The default weight 1 counts like one sample; it keeps unexcited eta finite;
    "cross-validated" chooses it (weight_selection.py). Stops at a Newton decrement of 1e-9 weight,
    within 400 iterations per stage. Assumes W exact and white noise per joint.
    """

    weight: float | str = 1.0
    iterations: int = 400  # of each stage
    bias: ClassVar[str] = (
        "drawn towards the prior; torques are taken to have 0.001 % of noise at least"
    )

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is neither positive nor the word for tuning."""
        check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction; raises
        EstimationError without a prior, or where the iteration does not converge."""
        return with_weight(self._fit, problem, self.weight)

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, prior = feasible_set_of(problem), find_prior(problem)
        x0 = feasible_point(feasible, prior.theta / feasible.scale, spread_of(feasible, prior))
        chart, base = coordinates(feasible, x0), scaled_coordinates(feasible, problem, x0)
        # u = inverse (x - origin), whose squares are the excess over least squares.
        inverse = np.linalg.inv(base.T)[: base.rank]
        eta, total = chart.eta0, 0
        share = 1.0 / max(float(np.linalg.norm(inverse @ (x0 - base.origin))), 1.0)
        while True:
            eta, count, decrement = newton_fit(
                share * inverse, base.origin, chart, eta, weight, self.iterations
            )
            total += count
            if share == 1.0:
                break
            share = min(share * STAGE, 1.0)
        stats = {
            "iterations": float(total),
            "decrement": decrement,
            "roundness": float(feasible.relative_margins(chart.x(eta)).min(initial=0.25)),
        }
        return Estimate(theta=feasible.scale * chart.x(eta), stats=stats)
