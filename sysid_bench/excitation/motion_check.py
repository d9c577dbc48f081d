"""Check of a motion, whoever made it: shapes, finite numbers, time grid, v and a as derivatives.

Central differences of q err by h^2 q''' / 6 at a step h (Taylor). The third derivative is that of
the motion itself, from its own differences, so that no tolerance is chosen: a smooth motion has a
narrow one, and a motion with corners a wider one where its corners are.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import Joint
from sysid_bench.spatial import composed_rotation, inverse_quaternion, rotation_of_quaternion
from sysid_bench.types import Array, Trajectory

SHORTEST: Final = 4
"""Samples of the shortest motion that has third differences."""

CORNERS: Final = 6.0
"""Tolerance in units of the Taylor error. At a corner the difference errs by up to half the jump;
of third differences next to it, one is at least half the jump times h: a sixth of that error."""

ROUNDING: Final = 1e-6
"""Share of the largest rate by which a rate may differ: rounding of solved or written numbers."""

GRID: Final = 1e-6
"""Share of the step by which times may leave their even grid: sums of rounded steps."""


DIGITS: Final = 64
"""Rounding errors of a position that closed chains or series have added up."""


@dataclass(frozen=True, eq=False)
class MotionSteps:
    """Increments `moves` (N - 1, nv) of a signal from sample to sample, by degree of freedom: of a
    quaternion the rotation vector between both (rad). `swing` (N - 2, nv): half the cross product
    of successive rotation vectors, by which their axis swings. `size` (nv,): that of the numbers it
    is computed from, at least 1."""

    moves: Array
    swing: Array
    size: Array


def check_motion(motion: Any, joints: Sequence[Joint], rate: float, origin: str) -> None:
    """Raise UsageError unless a motion of `joints` at `rate` (Hz) is consistent: t (N,), q (N, nq),
    v and a (N, nv) finite, even time steps, unit quaternions, v and a the derivatives of q and v.

    `origin` names the plug-in or the file in the message.
    """
    problem = motion_problem(motion, joints, rate)
    if problem is not None:
        raise UsageError(f"{origin}: {problem}.")


def motion_problem(motion: Any, joints: Sequence[Joint], rate: float) -> str | None:
    """Return the first inconsistency of a motion in words; None for a consistent one."""
    return (
        shape_problem(motion, joints)
        or time_problem(motion.t, rate)
        or next(_quaternion_problems(motion, joints), None)
        or next(derivative_problems(motion, joints), None)
    )


def shape_problem(motion: Any, joints: Sequence[Joint]) -> str | None:
    """Return what is wrong with the type, the shapes or the numbers of a motion."""
    if not isinstance(motion, Trajectory):
        return f"design returned {type(motion).__name__}, not a Trajectory"
    if not isinstance(motion.t, np.ndarray) or motion.t.ndim != 1 or len(motion.t) < SHORTEST:
        return f"t must be an array (N,) of at least {SHORTEST} times; got {_shown(motion.t)}"
    nv = sum(len(joint.dofs) for joint in joints)
    nq = nv + sum(joint.kind in ("ball", "free") for joint in joints)
    shapes = {"t": (len(motion.t),), "q": (len(motion.t), nq)}
    shapes |= dict.fromkeys("va", (len(motion.t), nv))
    problems = (_array_problem(name, getattr(motion, name), x) for name, x in shapes.items())
    return next(filter(None, problems), None)


def _array_problem(name: str, array: Any, shape: tuple[int, ...]) -> str | None:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        return f"{name} must be an array of real numbers; got {_shown(array)}"
    if array.shape != shape:
        return f"{name} has the shape {array.shape}; expected {shape}"
    if not np.isfinite(array).all():
        k = int(np.argwhere(~np.isfinite(array))[0][0])
        return f"{name} has values that are not finite, the first at sample {k}"
    return None


def _shown(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} of the shape {value.shape}"
    return type(value).__name__


def time_problem(t: Array, rate: float) -> str | None:
    """Return what is wrong with times (N,) that should be steps of 1 / `rate` (Hz)."""
    steps, step = np.diff(t), 1.0 / rate
    if not (steps > 0).all():
        k = int(np.argmin(steps > 0))
        return f"its times do not increase at sample {k + 1} ({t[k]:.6g} s, then {t[k + 1]:.6g} s)"
    # Times are sums or products of the step: rounding grows with their size.
    allowed = GRID * step + 2 * np.finfo(float).eps * np.abs(t).max()
    k = int(np.argmax(np.abs(steps - step)))
    if abs(steps[k] - step) <= allowed:
        return None
    return (
        f"its time steps are {steps.min():.6g} to {steps.max():.6g} s instead of {step:.6g} s; "
        "sample the motion at the rate of the design problem"
    )


def _quaternion_problems(motion: Trajectory, joints: Sequence[Joint]) -> Iterator[str]:
    """Yield quaternions that are not of length one: engines would scale them differently."""
    for joint in joints:
        if joint.kind in ("ball", "free"):
            first = joint.qadr + (3 if joint.kind == "free" else 0)
            off = np.abs(np.linalg.norm(motion.q[:, first : first + 4], axis=1) - 1.0)
            k = int(np.argmax(off))
            if off[k] > ROUNDING:
                yield (
                    f"the quaternion of {joint.name} has the length {1 + off[k]:.6g} or "
                    f"{1 - off[k]:.6g} at {motion.t[k]:.4g} s; normalise it"
                )


def derivative_problems(motion: Trajectory, joints: Sequence[Joint]) -> Iterator[str]:
    """Yield a sentence where v is not the derivative of q, and where a is not that of v."""
    step = float(motion.t[-1] - motion.t[0]) / (len(motion) - 1)
    gains = motion_steps(motion, joints)
    # Rates of splines have the rounding of the positions that they are made of.
    rates = MotionSteps(np.diff(motion.v, axis=0), np.zeros_like(gains.swing), gains.size / step)
    names = [dof for joint in joints for dof in joint.dofs]
    for name, of, change, rate in (("v", "q", gains, motion.v), ("a", "v", rates, motion.a)):
        expected, tolerance = _expected_rate(change, rate, step)
        error = np.abs(rate - expected) / tolerance
        at = np.unravel_index(int(np.argmax(error)), error.shape)
        if error[at] > 1.0:
            yield (
                f"{name} of {names[at[1]]} differs from the differences of {of} at "
                f"{motion.t[at[0]]:.4g} s: {rate[at]:.4g} instead of "
                f"{expected[at]:.4g}, tolerance {tolerance[at]:.2g} (rad or m, and s); {name} "
                f"must be the derivative of {of}, for rotations in the frame of the body"
            )


def motion_steps(motion: Trajectory, joints: Sequence[Joint]) -> MotionSteps:
    """Return the increments of the positions of a motion."""
    N, nv = motion.v.shape
    moves, swing, size = np.zeros((N - 1, nv)), np.zeros((N - 2, nv)), np.ones(nv)
    for joint in joints:
        first, dof = joint.qadr, joint.vadr
        if joint.kind != "ball":
            count = 3 if joint.kind == "free" else 1
            x = motion.q[:, first : first + count]
            moves[:, dof : dof + count] = np.diff(x, axis=0)
            size[dof : dof + count] = np.maximum(1.0, np.abs(x).max(axis=0))
            first, dof = first + count, dof + count
        if joint.kind in ("ball", "free"):
            turns = motion.q[:, first : first + 4]
            turn = rotation_of_quaternion(
                composed_rotation(inverse_quaternion(turns[:-1]), turns[1:])
            )
            moves[:, dof : dof + 3] = turn
            swing[:, dof : dof + 3] = 0.5 * np.cross(turn[:-1], turn[1:])
    return MotionSteps(moves, swing, size)


def _expected_rate(change: MotionSteps, rate: Array, step: float) -> tuple[Array, Array]:
    """Return the differences of a signal, by which its `rate` (N, n) is judged, and their
    tolerance (N, n)."""
    moves, N = change.moves, len(rate)
    taylor = np.full((N, 1), 1 / 6)
    taylor[[0, -1]] = 1 / 3  # one-sided differences of second order
    expected = np.empty_like(moves, shape=rate.shape)
    expected[1:-1] = 0.5 * (moves[:-1] + moves[1:])
    expected[0], expected[-1] = 1.5 * moves[0] - 0.5 * moves[1], 1.5 * moves[-1] - 0.5 * moves[-2]
    third = _near(np.abs(np.diff(moves, n=2, axis=0)), N)
    bends = _near(np.abs(np.diff(rate, n=2, axis=0)), N) * step
    # A spike in one of signal and rate widens its own differences alone: the other ones count. The
    # third derivative of a rotation vector is that of its rate, and half of w x dw/dt.
    tolerance = (
        CORNERS * taylor * (np.minimum(third, bends) + _near(np.abs(change.swing), N)) / step
    )
    digits = DIGITS * np.finfo(float).eps * change.size
    tolerance += ROUNDING * np.abs(rate).max(axis=0) + digits / step
    return expected / step, tolerance


def _near(differences: Array, N: int) -> Array:
    """Return the largest (N, n) of the differences (fewer than N, n) around each sample."""
    before = (N - len(differences)) // 2
    padding = ((before + 3, N - len(differences) - before + 3), (0, 0))
    padded = np.pad(differences, padding, mode="edge")
    return np.asarray(sliding_window_view(padded, 7, axis=0).max(axis=-1))
