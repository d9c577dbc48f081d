"""How far independent joints can go: limits within which every posture closes, is regular and
keeps the limits of the joints that follow."""

from typing import Final

import numpy as np

from sysid_bench.models.coupling.group import SINGULAR, Group
from sysid_bench.types import Array

REGULAR: Final = 0.2
"""Share of the reference's smallest singular value that a posture keeps, at least."""

RAY: Final = 48
"""Postures that are tried between the reference and a limit."""

INSIDE: Final = 0.95
"""Share of the way to where it ends that is used: between the postures tried it may end earlier."""

SCATTERED: Final = 128
"""Postures that are tried in the box of several independent joints."""

SHRUNK: Final = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2, 0.1, 0.05)


def reach_of(group: Group, low: Array, high: Array) -> tuple[Array, Array]:
    """Lowest and highest displacements (k - r,) of the independent joints; `low`, `high` (k,) bound
    the displacement of every joint of the group, infinite where nothing does."""
    moving, start = group.independent, group.reference[group.independent]
    bounds = np.stack([low[moving], high[moving]])
    keep = low - _ROUNDING, high + _ROUNDING
    # A reference outside of its own limits is where motions start all the same.
    keep = np.minimum(keep[0], group.reference), np.maximum(keep[1], group.reference)
    for i in range(len(moving)):
        for side in (0, 1):
            bounds[side, i] = _along(group, i, bounds[side, i], *keep)
    if len(moving) > 1:
        centre = np.clip(start, *bounds)
        bounds = centre + _share(group, bounds, centre, *keep) * (bounds - centre)
    return bounds[0], bounds[1]


def steepest(group: Group, low: Array, high: Array) -> Array:
    """Largest |F| (r, k - r) over postures within low and high (k - r,)."""
    x, _ = group.walked(_scattered(low, high))
    return np.abs(group.follow(x)).max(axis=0)


_ROUNDING: Final = 1e-9


def _along(group: Group, i: int, limit: float, low: Array, high: Array) -> float:
    """How far joint i goes towards a limit while the others rest."""
    start = group.reference[group.independent]
    if group.linear:
        return start[i] + _linear_share(group, i, limit - start[i], low, high) * (limit - start[i])
    shares = np.arange(1, RAY + 1) / RAY
    targets = np.tile(start, (RAY, 1))
    targets[:, i] += shares * (limit - start[i])
    good = _good(group, targets, low, high)
    if good.all():
        return limit
    reached = shares[int(np.argmin(good)) - 1] if good[0] else 0.0
    return float(start[i] + INSIDE * reached * (limit - start[i]))


def _linear_share(group: Group, i: int, stretch: float, low: Array, high: Array) -> float:
    """The share of a joint's way that the limits of the joints that follow it leave."""
    follow = group.dependent
    moves = group.follow(group.reference[None])[0][:, i] * stretch
    room = np.where(moves > 0, high[follow], low[follow]) - group.reference[follow]
    shares = room[moves != 0.0] / moves[moves != 0.0]
    return float(np.clip(shares.min(initial=1.0), 0.0, 1.0))


def _share(group: Group, bounds: Array, centre: Array, low: Array, high: Array) -> float:
    """The share of the box about its centre in which all postures are good."""
    points = _scattered(*(bounds - centre))
    for share in SHRUNK:
        if _good(group, centre + share * points, low, high).all():
            return share
    return 0.0


def _scattered(low: Array, high: Array) -> Array:
    """Points (M, n) of a box: random ones and, of few dimensions, its corners."""
    rng, n = np.random.default_rng(0), len(low)
    points = rng.uniform(size=(SCATTERED, n))
    if n <= 6:
        corners = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
        points = np.concatenate([corners, points])
    return low + points * (high - low)


def _good(group: Group, targets: Array, low: Array, high: Array) -> Array:
    if group.linear:
        x, good = group.closed(targets)
    else:
        x, good = group.walked(targets)
        margin = max(SINGULAR, REGULAR * float(group.regularity(group.reference[None])[0]))
        good = good & (group.regularity(x) >= margin)
    return good & ((x >= low) & (x <= high))[:, group.dependent].all(axis=1)
