"""From base parameters to whole bodies: the nearest to a prior that can exist."""

from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, unknown_name
from sysid_bench.identification.feasibility.bregman import Divergence, divergence, newton
from sysid_bench.identification.feasibility.feasible_set import FeasibleSet, feasible_set_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, fit, nearest
from sysid_bench.identification.feasibility.required_prior import (
    feasible_point,
    required_prior,
    spread_of,
    start_of,
)
from sysid_bench.identification.linear.base_coordinates import BaseCoordinates, unobserved
from sysid_bench.types import Array, BaseMap, Estimate, Prior, Problem

DISTANCES: Final = ("entropic", "euclidean", "pullback")

TINY: Final = 1e-12
"""N m and the like: a joint term of zero, whose logarithm is asked for."""


def complete(
    of: FeasibleSet, base: BaseMap, beta: Array, prior: Prior, distance: str = "entropic"
) -> Array:
    """theta (p,) that can exist, with K theta = beta, nearest to the prior in a distance: the
    log-det divergence ("entropic"), standard deviations ("euclidean"), or the metric of
    pseudo-inertias at the prior ("pullback").

    What beta does not tell is the prior's, moved as little as it takes. Raises EstimationError
    where nothing that can exist has these base parameters.
    """
    if distance not in DISTANCES:
        raise unknown_name("distance", distance, DISTANCES)
    std = spread_of(of, prior)
    x0 = feasible_point(of, prior.theta / of.scale, std)
    near = divergence(of, x0, std)
    metric = np.diag(1 / std**2) if distance == "euclidean" else near.metric
    found = nearest(of, base, beta, x0, metric)
    if distance != "entropic":
        return of.scale * found.x
    return of.scale * _entropic(near, found.x, unobserved(of, base))


def completed_estimate(estimate: Estimate, problem: Problem, distance: str) -> Estimate:
    """The estimate with a theta that can exist.

    It has the same base parameters; where noise has carried those out of all that can exist, the
    nearest that do, as the data weigh them, and `stats` tells in `moved` how much that adds to the
    squares of the residuals (noise has the variance one). Raises EstimationError without a prior,
    or where no such fit is found.
    """
    if estimate.beta is None:
        raise EstimationError("There are no base parameters to complete: the method gave none.")
    of, prior = feasible_set_of(problem), required_prior(problem)
    try:
        theta = complete(of, problem.base, estimate.beta, prior, distance)
    except EstimationError:
        return _moved(estimate, problem)
    return replace(estimate, theta=theta)


def _moved(estimate: Estimate, problem: Problem) -> Estimate:
    """The nearest to the base parameters of an estimate that can exist, as the data weigh them: on
    the border, where no distance has a choice left. A method's own that exist stay."""
    of, prior = feasible_set_of(problem), required_prior(problem)
    if estimate.theta is not None and _exists(of, estimate.theta):
        return estimate
    found = fit(of, problem, Limits(), start_of(of, prior))
    theta, stats = of.scale * found.x, {**estimate.stats, "moved": found.excess}
    return replace(estimate, beta=problem.base.K @ theta, theta=theta, stats=stats)


def _exists(of: FeasibleSet, theta: Array) -> bool:
    return bool(of.regularity(theta / of.scale).min(initial=0.25) > 0)


def _entropic(near: Divergence, start: Array, N: Array) -> Array:
    """Newton's method among start + N n, from one that can exist, if barely."""
    x = start.copy()
    terms = near.of.nonnegative
    x[terms] = np.maximum(x[terms], TINY)
    found, _, _ = newton(near, BaseCoordinates(x, N, 0), 1.0, np.zeros(N.shape[1]))
    return found
