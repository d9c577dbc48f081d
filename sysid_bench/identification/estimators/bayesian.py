"""Estimates drawn towards a prior, or towards zero."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.feasibility.feasible_set import find_prior
from sysid_bench.identification.linear.cross_validation import (
    WeightedPrior,
    check_weight,
    with_weight,
)
from sysid_bench.identification.linear.least_squares import check_rank, row_noise, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class PriorMean:
    """theta = theta0, the mean of the prior; covariance K diag(std^2) K' of the declared spread.

    The row against which a table shows what the data have added: a method that loses to it has
    made a good prior worse.
    """

    bias: ClassVar[str] = "the error of the prior, whatever the data"
    uses_data: ClassVar[bool] = False

    def solve(self, problem: Problem) -> Estimate:
        """Return the prior; raises EstimationError without one."""
        prior = find_prior(problem)
        root = problem.base.K * prior.std
        return Estimate(theta=np.array(prior.theta), covariance=root @ root.T)


@dataclass(frozen=True)
class APriori(WeightedPrior):
    """min |S^-1/2 (W K theta - b)|^2 + weight |(theta - theta0) / std|^2 over all p parameters.

    theta0 and std are mean and standard deviations of the prior, so that no unit is favoured; S is
    the noise variance per joint (as `wls`). Closed form by SVD. The default weight 1 gives the
    maximum a posteriori estimate, and the covariance of its posterior; "cross-validated" chooses
    the weight (cross_validation.py). Physical consistency is not imposed. Assumes W exact and white
    noise per joint. Tarantola (2005).
    """

    bias: ClassVar[str] = "drawn towards the prior, less so the more exact the data are"

    def _fit(self, problem: Problem, weight: float) -> Estimate:
        prior = find_prior(problem)
        K, std = problem.base.K, prior.std / np.sqrt(weight)
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        # In x = (theta - theta0) / std the prior is the unit ball, and the data a rank-r map of it.
        U, values, Vt = np.linalg.svd(R[:, :-1] @ (K * std), full_matrices=False)
        projected = U.T @ (R[:, -1] - R[:, :-1] @ (K @ prior.theta))
        theta = prior.theta + std * (Vt.T @ (values / (values**2 + 1.0) * projected))
        # Excited directions keep 1 / (s^2 + 1) of the prior's variance, all others the whole of it.
        excited = (K * std) @ Vt.T
        unexcited = K * std - excited @ Vt
        root = np.hstack([excited / np.sqrt(values**2 + 1.0), unexcited])
        return Estimate(theta=theta, covariance=root @ root.T)


WEIGHTS = tuple(10.0**k for k in range(-8, 1))
"""Weights that are tried: as many as of other methods (cross_validation.py)."""


@dataclass(frozen=True)
class Ridge:
    """min |S^-1/2 (W beta - b)|^2 + k |D beta|^2, D scaling the weighted columns to unit norm.

    S is the noise variance per joint (as `wls`), so that kg and kg m^2 are not mixed. `weight` is
    k; the default None takes r / |D beta|^2 of weighted least squares (Hoerl, Kennard, Baldwin
    1975), which vanishes for exact data; "cross-validated" chooses it from 1e-8 to 1, since k adds
    to squared singular values of unit columns (cross_validation.py). Closed form by SVD; the
    covariance is the variance without the bias. Assumes W exact and white noise per joint. Hoerl
    and Kennard (1970).
    """

    weight: float | str | None = None
    bias: ClassVar[str] = (
        "drawn towards zero by the weight; unbiased for exact data without a weight"
    )

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is not positive, nor a word that has a rule."""
        if self.weight is not None:
            check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; with a weight also where the motion does not excite every
        direction, without one EstimationError is raised there."""
        if self.weight is None:
            return self._fit(problem, None)
        return with_weight(self._fit, problem, self.weight, WEIGHTS)

    def _fit(self, problem: Problem, weight: float | None) -> Estimate:
        R = stacked_factor(problem, (1.0 / row_noise(problem)).tolist())
        norms = np.linalg.norm(R[:, :-1], axis=0)
        # Unit columns: one k acts alike on kg, kg m and kg m^2.
        norms = np.where(norms > 0, norms, 1.0)
        U, values, Vt = np.linalg.svd(R[:, :-1] / norms, full_matrices=False)
        projected = U.T @ R[:, -1]
        if weight is None:
            check_rank(stacked_factor(problem))
            # projected / values are the least-squares coefficients D beta in the singular basis.
            weight = problem.base.rank / max(float(np.sum((projected / values) ** 2)), 1e-300)
        gains = values / (values**2 + weight)
        root = Vt.T * gains / norms[:, None]
        beta = Vt.T @ (gains * projected) / norms
        return Estimate(beta, covariance=root @ root.T, stats={"weight": float(weight)})
