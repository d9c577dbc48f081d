"""Inputs of excitation design, and the motion of a robot from scalar profiles."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.collision_model import CollisionModel
from sysid_bench.excitation.information import InformationModel, TorqueModel
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.spatial import body_rates, composed_rotation, quaternion_of_rotation
from sysid_bench.types import Array, Trajectory

MARGIN: Final = 0.98
"""Share of a limit that a motion may use, so that it also holds between the points of a grid."""

FLOATING_REACH: Final = (0.3, 0.8)
"""Displacement of a floating base: m along each axis, and rad of its rotation vector."""


def is_count(value: object) -> bool:
    """Return true for an integer of at least 1 (True does not count)."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


_SAMPLES: Final = (10, 10_000_000)
"""Least and largest number of samples of a motion."""


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """Degrees of freedom of a robot, their limits, and what a criterion needs.

    Each has a scalar profile x: the position of a joint (rad, m); for a free joint displacement (3)
    and rotation vector (3) from its reference pose; for a ball joint the rotation vector. Limits
    low, high, v, a (nv,) are SI; `q0` (nq,) is the reference configuration. In closed chains only
    the independent joints have profiles and limits.

    None where a caller needs no such model: `regress`, regressor of the parameters asked for;
    `torque`, by the parameters known so far, with its limits `tau` (nv,); `scene`, collision model
    with a floor at some height (m; None: no floor).
    """

    joints: tuple[Joint, ...]
    low: Array
    high: Array
    v: Array
    a: Array
    q0: Array
    rate: float  # Hz
    coupling: Coupling | None = None
    tau: Array = field(default_factory=lambda: np.zeros(0))
    regress: InformationModel | None = None
    torque: TorqueModel | None = None
    scene: Callable[[float | None], CollisionModel] | None = None

    @property
    def nv(self) -> int:
        """Number of profiles."""
        return len(self.low)

    @property
    def dofs(self) -> Array:
        """Degree of freedom of the kinematic tree (nv,) that each profile moves."""
        return np.arange(self.nv) if self.coupling is None else self.coupling.independent

    def completed(self, motion: Trajectory, near: Trajectory | None = None) -> Trajectory:
        """Return the motion with dependent joints computed from the independent ones.

        `near`: a motion on the same grid as a first guess. Raises ModelError where a closed chain
        cannot be closed.
        """
        if self.coupling is None:
            return motion
        guess = None if near is None else near.q
        q, v, a = self.coupling.completed(motion.q, motion.v, motion.a, guess)
        return replace(motion, q=q, v=v, a=a)

    def at(self, rate: float) -> "DesignProblem":
        """Return the same problem sampled at another rate (Hz)."""
        return replace(self, rate=rate)

    def times(self, duration: float) -> Array:
        """Return the time grid (N,) in s of a motion; raises UsageError below 10 samples and above
        ten millions."""
        count = round(min(duration * self.rate, 1e15))
        if not _SAMPLES[0] <= count <= _SAMPLES[1]:
            raise UsageError(
                f"A motion of {duration:g} s at {self.rate:g} Hz has {count:g} samples; it needs "
                f"{_SAMPLES[0]}, and may have {_SAMPLES[1]:,}."
            )
        return np.arange(count) / self.rate

    def trajectory(
        self, t: Array, x: Array, dx: Array, ddx: Array, name: str, period: float | None = None
    ) -> Trajectory:
        """Return the motion of profiles x, dx, ddx (N, nv) with a name and a period (s)."""
        if self.coupling is None:
            return Trajectory(t, *self._tree_motion(x, dx, ddx), name, period)
        spread = (self.coupling.spread(profile) for profile in (x, dx, ddx))
        return Trajectory(t, *self.coupling.completed(*self._tree_motion(*spread)), name, period)

    def _tree_motion(self, x: Array, dx: Array, ddx: Array) -> tuple[Array, Array, Array]:
        """Return q (N, nq), v, a (N, nv) from profiles (N, nv) of every degree of freedom.

        Rotations are q0 * exp(x / 2), with v and a in the body frame.
        """
        q = np.tile(self.q0, (len(x), 1))
        v, a = dx.copy(), ddx.copy()
        for joint in self.joints:
            first, dof = joint.qadr, joint.vadr
            if joint.kind in ("hinge", "slide"):
                q[:, first] = x[:, dof]
                continue
            if joint.kind == "free":
                q[:, first : first + 3] += x[:, dof : dof + 3]
                first, dof = first + 3, dof + 3
            quaternion, part = slice(first, first + 4), slice(dof, dof + 3)
            q[:, quaternion] = composed_rotation(
                q[:, quaternion], quaternion_of_rotation(x[:, part])
            )
            v[:, part], a[:, part] = body_rates(x[:, part], dx[:, part], ddx[:, part])
        return q, v, a


def design_problem(robot: RobotModel, rate: float) -> DesignProblem:
    """Return the design problem of a robot within its own limits, sampled at `rate` (Hz).

    Free and ball joints have the ranges of FLOATING_REACH.
    """
    low, high, v, a = _profile_limits(robot)
    q0 = np.array(robot.mj.qpos0)
    tau = robot.limits.tau.copy()
    coupling = robot.coupling
    if coupling is not None:
        moving = coupling.independent
        scalar = coupling.qadr[moving] >= 0
        low = np.where(scalar, coupling.low, np.maximum(coupling.low, low[moving]))
        high = np.where(scalar, coupling.high, np.minimum(coupling.high, high[moving]))
        # Dependent joints may be geared up: `slower` keeps them within their own limits.
        v, a = coupling.slower * v[moving], coupling.slower * a[moving]
        q0 = coupling.default_closure(q0)
        tau = tau[moving]
    return DesignProblem(
        joints=robot.joints,
        low=low,
        high=high,
        v=v,
        a=a,
        q0=q0,
        rate=rate,
        coupling=coupling,
        tau=tau,
    )


def _profile_limits(robot: RobotModel) -> tuple[Array, Array, Array, Array]:
    """Return low, high, v, a (nv,) of the profiles of every degree of freedom of the tree."""
    low, high = robot.limits.q_low.copy(), robot.limits.q_high.copy()
    v, a = robot.limits.v.copy(), robot.limits.a.copy()
    for joint in robot.joints:
        first, end = joint.vadr, joint.vadr + len(joint.dofs)
        if joint.kind == "free":
            low[first : first + 3], high[first : first + 3] = -FLOATING_REACH[0], FLOATING_REACH[0]
            first += 3
        if joint.kind in ("free", "ball"):
            part = slice(first, end)
            low[part], high[part] = -FLOATING_REACH[1], FLOATING_REACH[1]
            # One body axis may see the whole rate of the rotation vector, sqrt(3) of a component;
            # that vector's curvature adds less than half the squared rate to the acceleration.
            a[part] = np.maximum(a[part] - 0.5 * v[part] ** 2, 0.5 * a[part]) / np.sqrt(3)
            v[part] /= np.sqrt(3)
    return low, high, v, a


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
