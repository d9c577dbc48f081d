"""Scaling of a motion's shape into position, velocity and acceleration limits."""

from collections.abc import Callable

import numpy as np

from sysid_bench.excitation.design_problem import MARGIN, DesignProblem
from sysid_bench.types import Array

Shape = Callable[[Array], tuple[Array, Array, Array]]
"""t (N,) to x, dx, ddx (N, nv), in closed form."""


def scale_to_limits(
    shape: Shape, grid: Array, brief: DesignProblem, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return scale and offset (nv,): scale * x + offset keeps the limits on the dense `grid`.

    The scale is the largest that each joint allows; where velocity or acceleration bind before the
    range does, the offset within the range is drawn.
    """
    x, dx, ddx = shape(grid)
    top, bottom = x.max(axis=0), x.min(axis=0)
    room = brief.high - brief.low
    with np.errstate(divide="ignore"):  # a joint that stands still has no bound
        scale = MARGIN * np.minimum.reduce(
            [
                room / (top - bottom),
                brief.v / np.abs(dx).max(axis=0),
                brief.a / np.abs(ddx).max(axis=0),
            ]
        )
    margin = 0.5 * (1 - MARGIN) * room
    first, last = brief.low + margin - scale * bottom, brief.high - margin - scale * top
    return scale, first + rng.uniform(size=brief.nv) * np.maximum(last - first, 0.0)


def dense_grid(duration: float, fastest: float) -> Array:
    """Return times (M,) in s with 40 points per period of the fastest frequency (Hz)."""
    return np.linspace(0.0, duration, max(200, int(40 * duration * fastest)) + 1)
