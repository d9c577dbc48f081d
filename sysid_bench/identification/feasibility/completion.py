"""Completion of base parameters to physically consistent bodies nearest to a prior."""

from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, unknown_name
from sysid_bench.identification.feasibility.divergence import divergence, newton
from sysid_bench.identification.feasibility.feasible_set import (
    BaseCoordinates,
    FeasibleSet,
    feasible_point,
    feasible_set_of,
    find_prior,
    nullspace,
    spread_of,
    start_of,
)
from sysid_bench.identification.feasibility.lmi_fit import Limits, fit, nearest
from sysid_bench.types import Array, BaseMap, Estimate, Prior, Problem

DISTANCES: Final = ("entropic", "euclidean", "pullback")

TINY: Final = 1e-12
"""Least joint term (SI) whose logarithm is taken."""


def completed_parameters(
    feasible: FeasibleSet, base: BaseMap, beta: Array, prior: Prior, distance: str = "entropic"
) -> Array:
    """Return the physically consistent theta (p,) with K theta = beta nearest to the prior.

    `distance`: log-det divergence ("entropic"), standard deviations ("euclidean"), or the
    affine-invariant metric at the prior ("pullback"). Raises EstimationError where no feasible
    theta has this beta, UsageError for an unknown distance.
    """
    if distance not in DISTANCES:
        raise unknown_name("distance", distance, DISTANCES)
    std = spread_of(feasible, prior)
    x0 = feasible_point(feasible, prior.theta / feasible.scale, std)
    near = divergence(feasible, x0, std)
    # "pullback" holds the affine-invariant metric at the prior, where it is the Hessian of the
    # entropic distance: the two agree near it.
    metric = np.diag(1 / std**2) if distance == "euclidean" else near.metric
    # The nearest point in a fixed metric also starts the entropic fit, which needs a feasible one.
    found = nearest(feasible, base, beta, x0, metric)
    if distance != "entropic":
        return np.asarray(feasible.scale * found.x)
    start, terms = found.x.copy(), feasible.nonnegative
    # The solver may leave terms on the boundary, where their logarithm is infinite.
    start[terms] = np.maximum(start[terms], TINY)
    N = nullspace(feasible, base)
    x, _, _ = newton(near, BaseCoordinates(start, N, 0), 1.0, np.zeros(N.shape[1]))
    return np.asarray(feasible.scale * x)


def completed_estimate(estimate: Estimate, problem: Problem, distance: str) -> Estimate:
    """Return the estimate with a physically consistent theta.

    beta is unchanged where it is feasible; otherwise it becomes the nearest feasible one in the
    metric of the data, and `stats["moved"]` is the increase of the sum of squares (unit noise
    variance). Raises EstimationError without a prior, or where no feasible fit is found.
    """
    if estimate.beta is None:
        raise EstimationError("The method returned no base parameters to complete.")
    feasible, prior = feasible_set_of(problem), find_prior(problem)
    try:
        theta = completed_parameters(feasible, problem.base, estimate.beta, prior, distance)
        return replace(estimate, theta=theta)
    except EstimationError:
        own = estimate.theta
    if own is not None and feasible.roundness(own / feasible.scale) > 0:
        return estimate  # a physically consistent theta of the method itself is kept
    # Nearest feasible estimate in the metric of the data: on the boundary, where no distance has a
    # choice left.
    found = fit(feasible, problem, Limits(), start_of(feasible, prior))
    theta, stats = feasible.scale * found.x, {**estimate.stats, "moved": found.excess}
    return replace(estimate, beta=problem.base.K @ theta, theta=theta, stats=stats)
