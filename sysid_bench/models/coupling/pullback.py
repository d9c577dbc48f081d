"""Derivatives of dependent joints by independent ones, along completed motions.

Dependent positions are x_dep = h(x), so that v_dep = F v with F = dh/dx, and a_dep = F a + v' h''
v. Terms with h'' come from central differences of closed postures, sample by sample.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.coupling.coupling import Coupling, names_of
from sysid_bench.models.coupling.group import Group, times
from sysid_bench.types import Array, Trajectory

Slopes = tuple[Array, Array, Array]
"""Derivatives of a scalar by q, v, a (N, nv) of a motion."""

STEP: Final = 1e-4
"""Step of the differences, in units of a joint: their error is of order STEP^2 = 1e-8, and rounding
of a closure over STEP is less."""


@dataclass(frozen=True, eq=False)
class _Curvature:
    """Derivatives of one group of coupled joints along a motion: `following` (r,) and `moving` (c,)
    are dofs of the tree; F (N, r, c); F_x (N, r, c, c), v_x and a_x (N, r, c) are the derivatives
    of F, v_dep and a_dep by the independent positions; None where F is constant."""

    following: Array
    moving: Array
    F: Array
    F_x: Array | None = None
    v_x: Array | None = None
    a_x: Array | None = None


def pullback(coupling: Coupling, motion: Trajectory, slopes: Slopes) -> Slopes:
    """Return derivatives of a scalar by the independent q, v, a, from those by q, v, a (N, nv) of
    all joints (chain rule); entries of dependent joints become zero."""
    if not any(slope[:, coupling.dependent].any() for slope in slopes):
        return slopes
    q, v, a = (slope.copy() for slope in slopes)
    for bend in _curvatures(coupling, motion):
        # The slopes of the dependent joints of a group move to its independent ones.
        dependent = [slope[:, bend.following] for slope in (q, v, a)]
        for slope, part in zip((q, v, a), dependent, strict=True):
            # dq_dep/dq, dv_dep/dv and da_dep/da are all F.
            slope[:, bend.moving] += np.einsum("nrc,nr->nc", bend.F, part)
            slope[:, bend.following] = 0.0
        if bend.v_x is not None and bend.a_x is not None:
            q[:, bend.moving] += np.einsum("nrc,nr->nc", bend.v_x, dependent[1])
            q[:, bend.moving] += np.einsum("nrc,nr->nc", bend.a_x, dependent[2])
            # h'' is symmetric: v' h'' v changes with v_j twice as v_dep does with x_j.
            v[:, bend.moving] += 2 * np.einsum("nrc,nr->nc", bend.v_x, dependent[2])
    return q, v, a


def pullback_follow(coupling: Coupling, motion: Trajectory, S: Array) -> Array:
    """Return derivatives (N, nv) of sum(S * F) by the independent q, S (N, m, n) as
    `Coupling.follow`."""
    out = np.zeros_like(motion.v)
    for bend in _curvatures(coupling, motion):
        if bend.F_x is not None:
            rows = np.searchsorted(coupling.dependent, bend.following)
            columns = np.searchsorted(coupling.independent, bend.moving)
            part = S[:, rows[:, None], columns]
            out[:, bend.moving] += np.einsum("nrcj,nrc->nj", bend.F_x, part)
    return out


@lru_cache(maxsize=4)
def _curvatures(coupling: Coupling, motion: Trajectory) -> tuple[_Curvature, ...]:
    """All groups along a completed motion; cached, since many scalars are derived for one
    motion."""
    return tuple(_curvature(coupling, group, motion) for group in coupling.groups)


def _curvature(coupling: Coupling, group: Group, motion: Trajectory) -> _Curvature:
    following, moving = group.dofs[group.dependent], group.dofs[group.independent]
    if (coupling.qadr[group.dofs] < 0).any():
        raise UnsupportedError(
            f"The closed chain of {names_of(coupling.names, group.dofs)} has ball or free joints; "
            "optimised motions cannot be designed for it. Use another excitation, such as fourier."
        )
    x = motion.q[:, coupling.qadr[group.dofs]] - coupling.q0[group.dofs]
    F = group.follow(x)
    if group.linear or len(moving) == 0:
        return _Curvature(following, moving, np.repeat(F, len(x), axis=0))
    v, a = motion.v[:, group.dofs], motion.a[:, moving]
    return _Curvature(following, moving, F, *_central_differences(group, x, v, a))


def _central_differences(group: Group, x: Array, v: Array, a: Array) -> list[Array]:
    """Derivatives of F (N, r, c), v_dep and a_dep (N, r) by the positions of the independent
    joints, which make the last axis (c). All postures are solved at once."""
    steps = STEP * group.units[group.independent]
    c, N = len(steps), len(x)
    moves = np.concatenate([np.diag(steps), -np.diag(steps)])
    x, v, a = (np.tile(values, (2 * c, 1)) for values in (x, v, a))
    x = group.step_closure(x, np.repeat(moves, N, axis=0))
    # F, v_dep and a_dep there, for rates v of the group and accelerations a of independent joints.
    F = group.follow(x)
    v[:, group.dependent] = times(F, v[:, group.independent])
    states = F, v[:, group.dependent], times(F, a) + group.drift(x, v)
    parts = [state.reshape(2, c, N, *state.shape[1:]) for state in states]
    return [np.moveaxis(up - down, 0, -1) / (2 * steps) for up, down in parts]
