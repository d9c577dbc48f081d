"""Limits of independent joints within which every posture closes, is regular and keeps the limits
of the dependent joints."""

from typing import Final

import numpy as np

from sysid_bench.models.coupling.group import SINGULAR, ClosureLimits, Group
from sysid_bench.types import Array

REGULAR: Final = 0.2
"""Least smallest singular value of a posture, as a share of that at the reference."""

STEPS: Final = 48
"""Least number of postures that are tried between the reference and a limit."""

INSIDE: Final = 0.95
"""Share of the way to the last good posture that is used: it may end between two that are tried."""

SCATTERED: Final = 64
"""Number of random postures that are tried in the box of independent joints."""

_ROUNDING: Final = 1e-9


def closure_limits(group: Group, low: Array, high: Array) -> tuple[Array, Array]:
    """Return lowest and highest displacements (k - r,) of the independent joints; `low`, `high`
    (k,) bound the displacements of all joints of the group, infinite where there is no limit."""
    moving = group.independent
    start, bounds = group.reference[moving], np.stack([low[moving], high[moving]])
    # Motions start at the reference even where it lies outside its limits.
    keep_low, keep_high = np.full(len(low), -np.inf), np.full(len(low), np.inf)
    follow = group.dependent
    keep_low[follow] = np.minimum(low[follow] - _ROUNDING, group.reference[follow])
    keep_high[follow] = np.maximum(high[follow] + _ROUNDING, group.reference[follow])
    margin = max(SINGULAR, REGULAR * float(group.condition(group.reference[None])[0]))
    keep = ClosureLimits(margin, keep_low, keep_high)
    # Each joint alone first, the others at the reference: one target per joint and side.
    sides = np.tile(start, (2, len(moving), 1))
    sides[:, np.arange(len(moving)), np.arange(len(moving))] = bounds
    shares = _shares(group, sides.reshape(-1, len(moving)), keep)
    bounds = start + shares.reshape(bounds.shape) * (bounds - start)
    # Then all together: the box shrinks as a whole until no way to its surface leaves the bounds.
    if len(moving) > 1:
        surface = start + _surface(bounds[0] - start, bounds[1] - start)
        bounds = start + _shares(group, surface, keep).min() * (bounds - start)
    return bounds[0], bounds[1]


def largest_jacobian(group: Group, low: Array, high: Array) -> Array:
    """Return the largest |F| (r, k - r) over postures within low and high (k - r,)."""
    # A fixed seed: limits belong to the model and are the same in every run.
    points = np.random.default_rng(0).uniform(size=(SCATTERED, len(low)))
    x, _ = group.follow_closure(np.concatenate([low + points * (high - low), [low, high]]))
    largest: Array = np.abs(group.follow(x)).max(axis=0)
    return largest


def _shares(group: Group, targets: Array, keep: ClosureLimits) -> Array:
    """Share (M,) of the way from the reference to each target along which all bounds hold."""
    if group.linear:
        return _linear_shares(group, targets, keep)
    _, shares = group.follow_closure(targets, keep, STEPS)
    return np.where(shares < 1.0, INSIDE * shares, 1.0)


def _linear_shares(group: Group, targets: Array, keep: ClosureLimits) -> Array:
    """The same in closed form: linear followers meet their limits on straight lines."""
    follow, start = group.dependent, group.reference
    # Displacement of each follower over the whole way, and how much of it its limits allow.
    moves = (targets - start[group.independent]) @ group.follow(start[None])[0].T
    allowed = np.where(moves > 0, keep.high[follow], keep.low[follow]) - start[follow]
    shares = np.full(moves.shape, 1.0)
    np.divide(allowed, moves, out=shares, where=np.abs(moves) > np.abs(allowed))
    least: Array = np.clip(shares, 0.0, 1.0).min(axis=1, initial=1.0)
    return least


def _surface(low: Array, high: Array) -> Array:
    """Points (M, n) on the faces of a box around the origin: random ones and, for n <= 6,
    corners."""
    n = len(low)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (SCATTERED, n))
    # Scaled to the largest entry: from inside the box onto its faces.
    points /= np.abs(points).max(axis=1, keepdims=True)
    if n <= 6:
        corners = 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1) - 1.0
        points = np.concatenate([corners, points])
    scaled: Array = np.where(points < 0, -points * low, points * high)
    return scaled
