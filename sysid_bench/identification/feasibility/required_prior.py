"""What a method is told beforehand: asked for in words, and made such that it can exist."""

from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import BASIS, FeasibleSet
from sysid_bench.types import Array, Prior, Problem

ROUND: Final = 1e-4
"""The least roundness of a prior body: point masses and sheets have no distance to anything."""

LIGHTEST: Final = 1e-3
"""kg; what a body that the prior says weighs nothing is taken for."""


def required_prior(problem: Problem) -> Prior:
    """The prior; raises EstimationError where there is none."""
    if problem.prior is None:
        raise EstimationError(
            "This method starts from a prior, and there is none: declare one "
            '(prior = { mass = "20 %", ... }), or take a method without.'
        )
    return problem.prior


def start_of(of: FeasibleSet, prior: Prior | None) -> Array:
    """x (p,) of the prior; without one solid spheres of a kilogram and of LENGTH, and no joint
    terms."""
    if prior is not None:
        return prior.theta / of.scale
    x = np.zeros(len(of.parameters))
    x[of.places[:, [0]]] = 1.0
    x[of.places[:, [4, 7, 9]]] = 0.4
    return x


def feasible_point(of: FeasibleSet, x: Array, std: Array) -> Array:
    """The nearest x (p,) whose bodies are strictly possible and whose joint terms are positive, by
    their spread `std` (p,) at least where they are zero."""
    out, J = x.copy(), of.pseudo_inertias(x)
    smallest = np.linalg.eigvalsh(J)[:, 0]
    trace = np.maximum(np.trace(J, axis1=1, axis2=2), LIGHTEST)
    lift = np.maximum(ROUND * trace - smallest, 0.0)
    # A multiple of the unit matrix: mass, and the same second moment along every axis.
    unit = np.linalg.lstsq(BASIS.reshape(10, 16).T, np.eye(4).ravel(), rcond=None)[0]
    out[of.places] += lift[:, None] * unit
    at = of.nonnegative
    out[at] = np.maximum(out[at], np.maximum(std[at], 1e-6) * (out[at] <= 0))
    return out


def spread_of(of: FeasibleSet, prior: Prior) -> Array:
    """Standard deviations of x (p,) as declared; a prior that claims to be exact is taken to be so
    to a millionth."""
    return np.maximum(prior.std / of.scale, 1e-6 * np.maximum(np.abs(prior.theta / of.scale), 1.0))
