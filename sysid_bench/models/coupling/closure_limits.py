"""How far independent joints can go: limits within which every posture closes, is regular and
keeps the limits of the joints that follow."""

from typing import Final

import numpy as np

from sysid_bench.models.coupling.group import SINGULAR, Group, SolverState
from sysid_bench.types import Array

REGULAR: Final = 0.2
"""Share of the reference's smallest singular value that a posture keeps, at least."""

STEPS: Final = 48
"""Postures that are tried between the reference and a limit, at least."""

INSIDE: Final = 0.95
"""Share of the way to where it ends that is used: between the postures tried it may end earlier."""

SCATTERED: Final = 64
"""Postures that are tried in the box of independent joints."""

_ROUNDING: Final = 1e-9


def closure_limits(group: Group, low: Array, high: Array) -> tuple[Array, Array]:
    """Lowest and highest displacements (k - r,) of the independent joints; `low`, `high` (k,) bound
    the displacement of every joint of the group, infinite where nothing does."""
    moving = group.independent
    start, bounds = group.reference[moving], np.stack([low[moving], high[moving]])
    # A reference outside of its own limits is where motions start all the same.
    keep_low, keep_high = np.full(len(low), -np.inf), np.full(len(low), np.inf)
    follow = group.dependent
    keep_low[follow] = np.minimum(low[follow] - _ROUNDING, group.reference[follow])
    keep_high[follow] = np.maximum(high[follow] + _ROUNDING, group.reference[follow])
    margin = max(SINGULAR, REGULAR * float(group.condition(group.reference[None])[0]))
    keep = SolverState(margin, keep_low, keep_high)
    sides = np.tile(start, (2, len(moving), 1))
    sides[:, np.arange(len(moving)), np.arange(len(moving))] = bounds
    shares = _shares(group, sides.reshape(-1, len(moving)), keep)
    bounds = start + shares.reshape(bounds.shape) * (bounds - start)
    if len(moving) > 1:
        surface = start + _surface(bounds[0] - start, bounds[1] - start)
        bounds = start + _shares(group, surface, keep).min() * (bounds - start)
    return bounds[0], bounds[1]


def largest_slope(group: Group, low: Array, high: Array) -> Array:
    """Largest |F| (r, k - r) over postures within low and high (k - r,)."""
    points = np.random.default_rng(0).uniform(size=(SCATTERED, len(low)))
    x, _ = group.continuation(np.concatenate([low + points * (high - low), [low, high]]))
    return np.abs(group.follow(x)).max(axis=0)


def _shares(group: Group, targets: Array, keep: SolverState) -> Array:
    """The share (M,) of the way from the reference to each target that is good."""
    if group.linear:
        return _linear_shares(group, targets, keep)
    _, shares = group.continuation(targets, keep, STEPS)
    return np.where(shares < 1.0, INSIDE * shares, 1.0)


def _linear_shares(group: Group, targets: Array, keep: SolverState) -> Array:
    """The same without a step: the limits of those that follow are met on straight ways."""
    follow, start = group.dependent, group.reference
    moves = (targets - start[group.independent]) @ group.follow(start[None])[0].T
    room = np.where(moves > 0, keep.high[follow], keep.low[follow]) - start[follow]
    shares = np.full(moves.shape, 1.0)
    np.divide(room, moves, out=shares, where=np.abs(moves) > np.abs(room))
    return np.clip(shares, 0.0, 1.0).min(axis=1, initial=1.0)


def _surface(low: Array, high: Array) -> Array:
    """Points (M, n) on the faces of a box around the origin: random ones and, of few dimensions,
    its corners."""
    n = len(low)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (SCATTERED, n))
    points /= np.abs(points).max(axis=1, keepdims=True)
    if n <= 6:
        corners = 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1) - 1.0
        points = np.concatenate([corners, points])
    return np.where(points < 0, -points * low, points * high)
