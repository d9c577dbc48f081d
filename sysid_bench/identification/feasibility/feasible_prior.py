"""Prior of methods that need one, and its nearest strictly feasible point."""

from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.feasibility.feasible_set import BASIS, FeasibleSet
from sysid_bench.types import Array, Prior, Problem

ROUND: Final = 1e-4
"""Least roundness of a prior body: the divergence from point masses and plates is infinite."""

LIGHTEST: Final = 1e-3
"""kg; mass of a body that the prior declares massless."""


def find_prior(problem: Problem) -> Prior:
    """Return the prior; raises EstimationError without one."""
    if problem.prior is None:
        raise EstimationError(
            "This method needs a prior: declare one "
            '(prior = { mass = "20 %", ... }), or use a method without.'
        )
    return problem.prior


def start_of(feasible: FeasibleSet, prior: Prior | None) -> Array:
    """x (p,) of the prior; without one, solid spheres of 1 kg and radius LENGTH, no joint terms."""
    if prior is not None:
        return np.asarray(prior.theta / feasible.scale)
    x = np.zeros(len(feasible.parameters))
    x[feasible.indices[:, [0]]] = 1.0
    # I = 2/5 m r^2 of a solid sphere.
    x[feasible.indices[:, [4, 7, 9]]] = 0.4
    return x


def feasible_point(feasible: FeasibleSet, x: Array, std: Array) -> Array:
    """Nearest strictly feasible x (p,); joint terms that are not positive become their standard
    deviation `std` (p,)."""
    out, J = x.copy(), feasible.pseudo_inertia(x)
    smallest = np.linalg.eigvalsh(J)[:, 0]
    trace = np.maximum(np.trace(J, axis1=1, axis2=2), LIGHTEST)
    # Adding a multiple of 1 to J shifts its eigenvalues and keeps its axes.
    lift = np.maximum(ROUND * trace - smallest, 0.0)
    # x of J = 1: mass, and equal second moments along all axes.
    unit = np.linalg.lstsq(BASIS.reshape(10, 16).T, np.eye(4).ravel(), rcond=None)[0]
    out[feasible.indices] += lift[:, None] * unit
    terms = feasible.nonnegative
    out[terms] = np.maximum(out[terms], np.maximum(std[terms], 1e-6) * (out[terms] <= 0))
    return out


def spread_of(feasible: FeasibleSet, prior: Prior) -> Array:
    """Declared standard deviations of x (p,), at least a millionth of its size."""
    return np.asarray(
        np.maximum(
            prior.std / feasible.scale, 1e-6 * np.maximum(np.abs(prior.theta / feasible.scale), 1.0)
        )
    )
