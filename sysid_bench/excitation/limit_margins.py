"""Margins of a motion to the limits of a robot's joints, between its samples too.

Between samples the motion is the quintic through q, v and a of both neighbours (Hermite), whose
error is of order h^6; where that and the cubic through two of the three differ, the motion is not
resolved there, and the one farther from the limit counts.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.motion_check import ROUNDING, motion_steps
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Row, Trajectory

PLACES: Final = (0.25, 0.5, 0.75, 1.0)
"""Places from one sample to the next, as shares of the step: a grid four times finer."""

CHUNK: Final = 1024
"""Steps evaluated at once, so that they stay in the cache of the processor."""

QUANTITIES: Final = ("position", "velocity", "acceleration")


@dataclass(frozen=True)
class Margins:
    """Smallest share of the limits of position, velocity and acceleration that motions leave: 1 in
    the middle of the range or at rest, 0 at a limit, negative beyond; None where none is stated.
    `broken` describes the worst violation, "" where there is none."""

    q: float | None = None
    v: float | None = None
    a: float | None = None
    broken: str = ""

    def with_motion(self, other: "Margins") -> "Margins":
        """Return the margins along both motions."""
        pairs = [(getattr(self, key), getattr(other, key)) for key in "qva"]
        stated = [[x for x in pair if x is not None] for pair in pairs]
        q, v, a = (min(given, default=None) for given in stated)
        return Margins(q, v, a, self.broken or other.broken)


def limit_margins(motion: Trajectory, robot: RobotModel) -> Margins:
    """Return the margins of a motion of a robot; dependent joints of closed chains have the limits
    that are stated for them."""
    centre, reach = _stated_bounds(robot)
    step = float(motion.t[1] - motion.t[0])
    # Ends q0, q1 - q0, v0, v1, a0, a1 of each step (6, N - 1, nv), in units of the step, in which
    # the weights of the polynomials are plain numbers; q0 of a rotation is zero.
    q = np.zeros_like(motion.v)
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            q[:, joint.vadr] = motion.q[:, joint.qadr]
    moves = motion_steps(motion, robot.joints).moves
    v, a = step * motion.v, step**2 * motion.a
    ends = np.array([q[:-1], moves, v[:-1], v[1:], a[:-1], a[1:]])
    ends[0] -= centre[0]
    size, place = _largest_values(ends)
    # A limit of zero is kept by zero alone, an infinite one by all.
    allowed = np.maximum(reach * step ** np.arange(3)[:, None], np.finfo(float).tiny)
    # Largest shares of the limits (3, nv), 0 without a limit, and their times (s).
    use, time = size / allowed, motion.t[0] + step * place
    stated = np.isfinite(reach).any(axis=1)
    pairs = zip(use, stated, strict=True)
    left = [float(1 - x.max()) if given else None for x, given in pairs]
    kind, dof = np.unravel_index(int(np.argmax(use)), use.shape)
    broken = ""
    if use[kind, dof] > 1 + ROUNDING:
        broken = (
            f"the {QUANTITIES[kind]} of {robot.rows[dof]} exceeds its limit by "
            f"{100 * (use[kind, dof] - 1):.3g} % at {time[kind, dof]:.4g} s"
        )
    return Margins(q=left[0], v=left[1], a=left[2], broken=broken)


def _largest_values(ends: Array) -> tuple[Array, Array]:
    """Largest absolute position, velocity and acceleration (3, nv) in steps with these ends, and
    their places in steps from the start."""
    size, place = np.abs(ends[[0, 2, 4]]).max(axis=1), np.abs(ends[[0, 2, 4]]).argmax(axis=1)
    for start in range(0, ends.shape[1], CHUNK):
        part = ends[:, start : start + CHUNK]
        for share, weights in _WEIGHTS.items():
            values = np.tensordot(weights, part, axes=1)  # (6, n, nv): quintic, cubics
            np.abs(values, out=values)
            between = np.minimum(values[:3], values[3:], out=values[:3])
            k = between.argmax(axis=1)
            found = np.take_along_axis(between, k[:, None], axis=1)[:, 0]
            place = np.where(found > size, start + k + share, place)
            size = np.maximum(found, size)
    return size, place


def check_limits(margins: Margins, origin: str) -> None:
    """Raise UsageError where a motion breaks a limit; `origin` names the plug-in or the file."""
    if margins.broken:
        raise UsageError(
            f"{origin}: {margins.broken}; slow the motion down, raise the limit in the manifest, "
            'or have rows marked instead by the setting limits = "mark" of the excitation.'
        )


def limit_fields(margins: Margins) -> Row:
    """Return the row fields of margins; `limits_broken` is "" where all limits are kept."""
    return {
        "q_margin": margins.q,
        "v_margin": margins.v,
        "a_margin": margins.a,
        "limits_broken": margins.broken,
    }


def _stated_bounds(robot: RobotModel) -> tuple[Array, Array]:
    """Return centres and reaches (3, nv) of q, v, a (rad, m, s), the centres of v and a zero; a
    reach is infinite without a limit."""
    limits = robot.limits
    low, high, v, a = (x.copy() for x in (limits.q_low, limits.q_high, limits.v, limits.a))
    closure = robot.coupling
    if closure is not None:
        # The reference posture of a closed chain may lie outside a limit, which is then not kept.
        moving = closure.independent
        low[moving] = np.minimum(low[moving], closure.low)
        high[moving] = np.maximum(high[moving], closure.high)
        for x, bound in zip((low, high, v, a), closure.bounds, strict=True):
            x[closure.dependent] = bound
        for x in (v, a):
            x[closure.free_dofs] = np.inf
    stated = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(stated, low, -1.0), np.where(stated, high, 1.0)
    middle, still = 0.5 * (high + low), np.zeros_like(v)
    reach = np.where(stated, 0.5 * (high - low), np.inf)
    return np.array([middle, still, still]), np.array([reach, v, a])


def _weights(s: float) -> Array:
    """Return weights (6, 6) of the ends of a step at the share s of it: q, v, a of the quintic
    through q, v, a of both ends, then q of the cubic through q and v, and v and a of that through
    v and a."""
    q0, dq, v0, v1, a0, a1 = np.eye(6)
    left, dv, da = dq - v0 - 0.5 * a0, v1 - v0 - a0, a1 - a0
    c3 = 10 * left - 4 * dv + 0.5 * da
    c4, c5 = -15 * left + 7 * dv - da, 6 * left - 3 * dv + 0.5 * da
    quintic = (
        q0 + s * v0 + 0.5 * s**2 * a0 + s**3 * c3 + s**4 * c4 + s**5 * c5,
        v0 + s * a0 + 3 * s**2 * c3 + 4 * s**3 * c4 + 5 * s**4 * c5,
        a0 + 6 * s * c3 + 12 * s**2 * c4 + 20 * s**3 * c5,
    )
    position, _ = _cubic(q0, dq, (v0, v1), s)
    return np.array([*quintic, position, *_cubic(v0, v1 - v0, (a0, a1), s)])


def _cubic(x: Array, gain: Array, rates: tuple[Array, Array], s: float) -> tuple[Array, Array]:
    """Return value and rate of a cubic from x with a gain, and the rates of both ends."""
    start, end = rates
    c2, c3 = 3 * gain - 2 * start - end, start + end - 2 * gain
    return x + s * (start + s * (c2 + s * c3)), start + s * (2 * c2 + s * 3 * c3)


_WEIGHTS: Final = {place: _weights(place) for place in PLACES}
