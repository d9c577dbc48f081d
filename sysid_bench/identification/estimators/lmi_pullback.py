"""Physically consistent fit with the affine-invariant metric at the prior."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.identification.feasibility.divergence import divergence
from sysid_bench.identification.feasibility.feasible_prior import (
    feasible_point,
    find_prior,
    spread_of,
)
from sysid_bench.identification.feasibility.feasible_set import feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, estimate_of, fit
from sysid_bench.identification.linear.cross_validation import check_weight, with_weight
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class LMIPullback:
    """min |S^-1/2 (W K theta - b)|^2 + weight d' M d, d = theta - theta0, under the LMIs of `lmi`.

    M_kl = tr(J0^-1 E_k J0^-1 E_l) is the affine-invariant metric of pseudo-inertias, pulled back to
    theta and held at the prior: invariant to frames and units. With the default weight 1 the prior
    counts like one sample; "cross-validated" chooses it (weight_selection.py). Solved by Clarabel
    to a duality gap of 1e-7; margin as in `lmi`. Assumes W exact and white noise per joint. Lee and
    Park (2018); Lee, Wensing, Park (2020).
    """

    weight: float | str = 1.0
    margin: float = 1e-7
    bias: ClassVar[str] = (
        "drawn towards the prior; torques are taken to have 0.001 % of noise at least"
    )

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is neither positive nor the word for tuning."""
        check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction; raises
        EstimationError without a prior, or where Clarabel does not solve the program."""
        return with_weight(self._fit, problem, self.weight)

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        feasible, prior = feasible_set_of(problem), find_prior(problem)
        std = spread_of(feasible, prior)
        x0 = feasible_point(feasible, prior.theta / feasible.scale, std)
        metric = divergence(feasible, x0, std).metric
        return estimate_of(
            feasible, fit(feasible, problem, Limits(self.margin), x0, weight * metric)
        )
