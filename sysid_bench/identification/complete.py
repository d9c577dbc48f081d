"""From base parameters to whole bodies: the feasible theta with K theta = beta nearest to a prior."""

from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, unknown_name
from sysid_bench.identification.bregman import divergence, newton
from sysid_bench.identification.feasible import Limits, nearest
from sysid_bench.identification.physical import Physical
from sysid_bench.identification.prior import existing, spread_of
from sysid_bench.types import Array, BaseMap, Prior

DISTANCES: Final = ("entropic", "euclidean", "pullback")

STIFF: Final = 1e-5
"""Of a base parameter's scale: how near Newton's method brings it before the rest is solved for."""


def completed(
    of: Physical, base: BaseMap, beta: Array, prior: Prior, distance: str = "entropic"
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
    x0 = existing(of, prior.theta / of.scale, std)
    A = base.K * of.scale
    if distance == "entropic":
        return of.scale * _entropic(of, A, beta, x0, std)
    free = np.setdiff1d(np.arange(len(x0)), base.pivots)
    N = np.zeros((len(x0), len(free)))
    N[free] = np.eye(len(free))
    N[base.pivots] = -A[:, free] / of.scale[base.pivots, None]
    metric = np.diag(1 / std**2)
    if distance == "pullback":
        _, metric = divergence(of, x0, std).derivatives(x0)
    found = nearest(of, Limits(), base.embed(beta) / of.scale, N, x0, metric)
    x = found.x.copy()
    x[of.not_negative] = np.maximum(x[of.not_negative], 0.0)
    return of.scale * _on(A, beta, x)


def _entropic(of: Physical, A: Array, beta: Array, x0: Array, std: Array) -> Array:
    """Newton's method with K theta = beta as a stiff spring, then the rest of the way at once."""
    stiffness = 1 / (STIFF * np.linalg.norm(A, axis=1))
    near = divergence(of, x0, std)
    x, _, _ = newton(stiffness[:, None] * A, stiffness * beta, 1.0, near, iterations=200)
    on = _on(A, beta, x)
    if not np.isfinite(near.value(on)):
        missed = np.abs(stiffness * STIFF * (A @ x - beta)).max()
        raise EstimationError(
            "No bodies that can exist have these base parameters: the nearest ones miss them by "
            f"{missed:.1e} of their scale. Take a feasible fit ('lmi', 'entropic') instead."
        )
    return on


def _on(A: Array, beta: Array, x: Array) -> Array:
    """The nearest x (p,) with A x = beta."""
    return x + np.linalg.lstsq(A, beta - A @ x, rcond=None)[0]
