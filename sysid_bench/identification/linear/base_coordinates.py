"""Parameters seen from the base: what squares feel, and what they do not.

Feasible fits have to move along parameters that the torques do not feel at all beside others that
they feel strongly. In these coordinates the two never meet, so that both are solved for to their
own accuracy: normal equations of all parameters would lose the one in the rounding of the other.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import qr

from sysid_bench.identifiability.verdicts import coefficients
from sysid_bench.identification.feasibility.feasible_set import FeasibleSet
from sysid_bench.identification.linear.normal_qr import (
    excited_rank,
    inverse_of,
    solve_upper,
    stacked_factor,
)
from sysid_bench.identification.linear.weights import row_sigmas, torque_rms
from sysid_bench.types import Array, BaseMap, Problem

NOISE: Final = 1e-5
"""Of a joint's RMS torque: the least noise that feasible fits take it to have."""

WEAK: Final = 1e-4
"""The square of one kilogram away from the start, where nothing else decides: a ten-thousandth of
what the noise of one sample costs."""


@dataclass(frozen=True, eq=False)
class BaseCoordinates:
    """x = origin + T y with y = (u, n): |u|^2 is what a fit adds to the squares of least squares, n
    (p - r,) the change of the parameters beside the pivots, which the torques do not feel."""

    origin: Array
    T: Array
    rank: int

    def x(self, y: Array) -> Array:
        """x (p,)."""
        return self.origin + self.T @ y

    def y(self, x: Array) -> Array:
        """y (p,) of x (p,)."""
        return np.linalg.solve(self.T, x - self.origin)


def base_coordinates(of: FeasibleSet, base: BaseMap, R: Array, start: Array) -> BaseCoordinates:
    """Coordinates around the least-squares fit of the factor R (r + 1, r + 1) that is nearest to
    `start` (p,) outside of the pivots; what the data do not excite is drawn to the start weakly."""
    r, p = base.rank, len(start)
    if excited_rank(R[:r, :r]) < r:
        pull = np.sqrt(WEAK) / np.linalg.norm(base.K * of.scale, axis=1)
        rows = np.column_stack([np.diag(pull), pull * (base.K @ (of.scale * start))])
        R = np.asarray(qr(np.vstack([R, rows]), mode="r")[0])[: r + 1]
    scale = of.scale[base.pivots]
    T, origin = np.zeros((p, p)), start.copy()
    T[base.pivots, :r] = inverse_of(R) / scale[:, None]
    T[:, r:] = unobserved(of, base)
    free = np.setdiff1d(np.arange(p), base.pivots)
    origin[base.pivots] = solve_upper(R) / scale + T[base.pivots, r:] @ start[free]
    return BaseCoordinates(origin, T, r)


def unobserved(of: FeasibleSet, base: BaseMap) -> Array:
    """N (p, p - r) with K scale N = 0: a unit of each parameter beside the pivots, and what takes
    it back from those. Sparse, as base parameters group neighbours."""
    p = len(of.parameters)
    free = np.setdiff1d(np.arange(p), base.pivots)
    N = np.zeros((p, len(free)))
    N[free, np.arange(len(free))] = 1.0
    N[base.pivots] = -coefficients(base)[:, free] * of.scale[free] / of.scale[base.pivots, None]
    return N


def weighted_coordinates(of: FeasibleSet, problem: Problem, start: Array) -> BaseCoordinates:
    """Coordinates of the rows, each divided by its noise, which is at least NOISE of the torque:
    below, the weights of joints would differ by more than a solver can tell."""
    sigma = np.maximum(row_sigmas(problem), NOISE * torque_rms(problem))
    R = stacked_factor(problem, (1.0 / np.where(sigma > 0, sigma, 1.0)).tolist())
    return base_coordinates(of, problem.base, R, start)
