"""Coordinates of the parameters that separate observable from unobservable directions.

Feasible fits move along both. In these coordinates the two are decoupled, so that each is solved to
its own accuracy; normal equations of all parameters would lose the unobservable ones in the
rounding of the observable ones.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import qr

from sysid_bench.identifiability.parameter_verdict import coefficients
from sysid_bench.identification.feasibility.feasible_set import FeasibleSet
from sysid_bench.identification.linear.least_squares import (
    RESIDUALS,
    data_rank,
    inverse_of,
    row_std,
    solve_factor,
    stacked_factor,
    torque_rms,
)
from sysid_bench.types import Array, BaseMap, Problem

NOISE: Final = 1e-5
"""Least noise of a joint in feasible fits, relative to its RMS torque."""

WEAK: Final = 1e-4
"""Weight of the squared distance (kg) from the start along unexcited directions: a ten-thousandth
of the noise variance of one sample, which has weight one."""


@dataclass(frozen=True, eq=False)
class BaseCoordinates:
    """x = origin + T y with y = (u, n): |u|^2 is the excess over the least-squares residual, n (p -
    r,) the change of the non-pivot parameters, which the torques do not depend on."""

    origin: Array
    T: Array
    rank: int

    def x(self, y: Array) -> Array:
        """x (p,) of y (p,)."""
        return np.asarray(self.origin + self.T @ y)

    def y(self, x: Array) -> Array:
        """y (p,) of x (p,)."""
        return np.linalg.solve(self.T, x - self.origin)


def base_coordinates(
    feasible: FeasibleSet, base: BaseMap, R: Array, start: Array
) -> BaseCoordinates:
    """Coordinates about the least-squares solution of the factor R (r + 1, r + 1) whose non-pivot
    parameters are those of `start` (p,); unexcited directions are weakly drawn to the start."""
    r, p = base.rank, len(start)
    if data_rank(R[:r, :r]) < r:
        # A weak row per base parameter makes R regular; excited directions hardly feel it.
        pull = np.sqrt(WEAK) / np.linalg.norm(base.K * feasible.scale, axis=1)
        rows = np.column_stack([np.diag(pull), pull * (base.K @ (feasible.scale * start))])
        R = np.asarray(qr(np.vstack([R, rows]), mode="r")[0])[: r + 1]
    scale = feasible.scale[base.pivots]
    T, origin = np.zeros((p, p)), start.copy()
    # u = R (beta - beta_ls): unit u adds one to the squares, whatever the direction.
    T[base.pivots, :r] = inverse_of(R) / scale[:, None]
    T[:, r:] = nullspace(feasible, base)
    free = np.setdiff1d(np.arange(p), base.pivots)
    origin[base.pivots] = solve_factor(R) / scale + T[base.pivots, r:] @ start[free]
    return BaseCoordinates(origin, T, r)


def nullspace(feasible: FeasibleSet, base: BaseMap) -> Array:
    """N (p, p - r) with K scale N = 0: unit changes of the non-pivot parameters, compensated by the
    pivots. Sparse, since base parameters group neighbouring bodies."""
    p = len(feasible.parameters)
    free = np.setdiff1d(np.arange(p), base.pivots)
    N = np.zeros((p, len(free)))
    N[free, np.arange(len(free))] = 1.0
    N[base.pivots] = (
        -coefficients(base)[:, free] * feasible.scale[free] / feasible.scale[base.pivots, None]
    )
    return N


def scaled_coordinates(
    feasible: FeasibleSet, problem: Problem, start: Array, weights: str = RESIDUALS
) -> BaseCoordinates:
    """Coordinates of rows divided by `row_std`, at least NOISE of the torque: below it the
    weights of joints would differ by more than a solver resolves."""
    sigma = np.maximum(row_std(problem, weights), NOISE * torque_rms(problem))
    R = stacked_factor(problem, (1.0 / np.where(sigma > 0, sigma, 1.0)).tolist())
    return base_coordinates(feasible, problem.base, R, start)
