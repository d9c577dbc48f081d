"""Feasible set of physically consistent parameters, its prior, and coordinates of its fits.

A body is physically consistent iff its pseudo-inertia J(phi) (4, 4) is positive definite (Wensing,
Kim, Slotine 2018). With lengths in units of LENGTH, the margin J >= margin tr(J) 1 is linear in
phi, scales with the body's mass and holds for a massless body. Friction and rotor inertia are not
negative; a stiffness may be, since counterbalances and cables act like one.

Feasible fits move along observable and unobservable directions. In base coordinates the two are
decoupled, so that each is solved to its own accuracy; normal equations of all parameters would lose
the unobservable ones in the rounding of the observable ones."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from scipy.linalg import qr

from sysid_bench.errors import EstimationError
from sysid_bench.identifiability.base_expressions import coefficients
from sysid_bench.identification.linear.least_squares import (
    RESIDUALS,
    data_rank,
    inverse_of,
    row_std,
    solve_factor,
    stacked_factor,
    torque_rms,
)
from sysid_bench.spatial import pseudo_inertia
from sysid_bench.types import Array, BaseMap, Body, Prior, Problem

LENGTH: Final = 0.1
"""m; a typical link size: moments of inertia of 1 kg are then of the order of one."""

NOT_NEGATIVE: Final = (".fv", ".fc", ".Ia")
"""Suffixes of viscous and Coulomb friction and of the inertia of rotors."""

SCALE: Final = np.array([1.0] + [LENGTH] * 3 + [LENGTH**2] * 6)
"""phi (10,) of a body of 1 kg and LENGTH."""

_UNITS: Final = np.diag([1 / LENGTH] * 3 + [1.0])
BASIS: Final = _UNITS @ pseudo_inertia(np.diag(SCALE)) @ _UNITS
"""dJ/dx (10, 4, 4), J in LENGTH and kg, of phi = SCALE x."""


@dataclass(frozen=True, eq=False)
class FeasibleSet:
    """Indices of bodies and joint terms in the scaled parameters x (p,), theta = scale x. `signed`:
    joint terms that must not be negative; None: those of NOT_NEGATIVE."""

    parameters: tuple[str, ...]
    bodies: tuple[Body, ...]
    signed: tuple[str, ...] | None = None

    @cached_property
    def indices(self) -> Array:
        """Indices (nb, 10) of the parameters of each body."""
        index = {name: i for i, name in enumerate(self.parameters)}
        indices = [[index[column] for column in body.columns] for body in self.bodies]
        return np.array(indices, dtype=int).reshape(-1, 10)

    @cached_property
    def nonnegative(self) -> Array:
        """Indices (k,) of non-negative joint terms; coupled viscous friction has either sign."""
        inertial = set(self.indices.ravel().tolist())
        signed = self.signed
        if signed is None:
            signed = tuple(name for name in self.parameters if name.endswith(NOT_NEGATIVE))
        found = [i for i, name in enumerate(self.parameters) if name in signed]
        return np.array([i for i in found if i not in inertial], dtype=int)

    @cached_property
    def scale(self) -> Array:
        """Scale (p,): theta of x = 1."""
        scale = np.ones(len(self.parameters))
        scale[self.indices] = SCALE
        return scale

    def pseudo_inertia(self, x: Array) -> Array:
        """Pseudo-inertias J (nb, 4, 4), lengths in LENGTH, kg."""
        return np.asarray(np.einsum("bk,kij->bij", x[self.indices], BASIS))

    def relative_margins(self, x: Array) -> Array:
        """Smallest eigenvalue of each J over its trace (nb,), at most 1/4; 0 if massless."""
        J = self.pseudo_inertia(x)
        trace = np.trace(J, axis1=1, axis2=2)
        smallest = np.linalg.eigvalsh(J)[:, 0]
        return np.where(
            np.abs(trace) > 1e-12, smallest / np.where(trace == 0, 1.0, np.abs(trace)), smallest
        )

    def roundness(self, x: Array) -> float:
        """Smallest eigenvalue of any J over its trace; 1/4, that of a ball, without bodies."""
        return float(self.relative_margins(x).min(initial=0.25))


@lru_cache(maxsize=64)
def feasible_set(
    parameters: tuple[str, ...], bodies: tuple[Body, ...], signed: tuple[str, ...] | None = None
) -> FeasibleSet:
    """Feasible set of a robot, cached."""
    return FeasibleSet(parameters, bodies, signed)


def feasible_set_of(problem: Problem) -> FeasibleSet:
    """Feasible set of a problem's parameters."""
    return feasible_set(problem.parameters, problem.bodies, problem.signed)


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


def feasible_prior(problem: Problem) -> tuple[FeasibleSet, Array, Array]:
    """Return the feasible set, the prior's nearest strictly feasible x (p,) and its standard
    deviations (p,); raises EstimationError without a prior."""
    feasible, prior = feasible_set_of(problem), find_prior(problem)
    std = spread_of(feasible, prior)
    return feasible, feasible_point(feasible, prior.theta / feasible.scale, std), std


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
