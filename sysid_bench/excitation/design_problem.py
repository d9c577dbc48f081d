"""What a designer of motions is told, and how scalar profiles become a motion of the robot."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.spatial.rotation import body_rates, product, quaternion_of_vector
from sysid_bench.types import Array, Trajectory

if TYPE_CHECKING:
    from sysid_bench.excitation.geometry import CollisionModel
    from sysid_bench.excitation.information import InformationModel, TorqueModel

MARGIN: Final = 0.98
"""Share of a limit that a motion may use: sampling between grid points stays inside."""

FLOATING_REACH: Final = (0.3, 0.8)
"""How far a floating base is moved: metres, and radians of its rotation vector."""


def is_count(value: object) -> bool:
    """Whether a setting is a whole number from 1 on."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """A robot's moves and limits. Each degree of freedom has a scalar profile x: a joint position,
    or for a free joint the displacement (3) and rotation vector (3) from its reference pose, for a
    ball joint the rotation vector. Arrays (nv,); `q0` (nq,) is the reference configuration.

    Of coupled joints the profiles, and the arrays, are those of the independent ones alone.

    What only some designers need is None where nobody has told it: `regress`, the rows that are to
    tell the parameters; `torque`, by what is known of the robot so far, and its limits `tau` (nv,);
    `scene`, the robot's shapes beside a floor of some height (m; None: no floor)."""

    joints: tuple[Joint, ...]
    low: Array
    high: Array
    v: Array
    a: Array
    q0: Array
    rate: float  # Hz
    coupling: Coupling | None = None
    tau: Array = field(default_factory=lambda: np.zeros(0))
    regress: "InformationModel | None" = None
    torque: "TorqueModel | None" = None
    scene: "Callable[[float | None], CollisionModel] | None" = None

    @property
    def nv(self) -> int:
        """Number of profiles."""
        return len(self.low)

    @property
    def dofs(self) -> Array:
        """Degree of freedom of the tree (nv,) that each profile moves."""
        return np.arange(self.nv) if self.coupling is None else self.coupling.independent

    def completed(self, motion: Trajectory, near: Trajectory | None = None) -> Trajectory:
        """The motion with the joints that follow where the independent ones put them; a motion
        `near` it on the same grid saves time.

        Raises ModelError where the closure is lost.
        """
        if self.coupling is None:
            return motion
        beside = None if near is None else near.q
        q, v, a = self.coupling.completed(motion.q, motion.v, motion.a, beside)
        return replace(motion, q=q, v=v, a=a)

    def at(self, rate: float) -> "DesignProblem":
        """The same brief sampled at another rate (Hz)."""
        return replace(self, rate=rate)

    def times(self, duration: float) -> Array:
        """The time grid (N,) of a motion; raises UsageError where it has fewer than ten samples."""
        count = round(duration * self.rate)
        if count < 10:
            raise UsageError(
                f"A motion of {duration} s at {self.rate} Hz has {count} samples; it needs 10."
            )
        return np.arange(count) / self.rate

    def trajectory(
        self, t: Array, x: Array, dx: Array, ddx: Array, name: str, period: float | None = None
    ) -> Trajectory:
        """The motion of profiles x, dx, ddx (N, nv)."""
        if self.coupling is None:
            return Trajectory(t, *self._tree_motion(x, dx, ddx), name, period)
        spread = (self.coupling.spread(profile) for profile in (x, dx, ddx))
        return Trajectory(t, *self.coupling.completed(*self._tree_motion(*spread)), name, period)

    def _tree_motion(self, x: Array, dx: Array, ddx: Array) -> tuple[Array, Array, Array]:
        """q, v, a of profiles (N, nv) of every degree of freedom."""
        q = np.tile(self.q0, (len(x), 1))
        v, a = dx.copy(), ddx.copy()
        for joint in self.joints:
            at, dof = joint.qadr, joint.vadr
            if joint.kind in ("hinge", "slide"):
                q[:, at] = x[:, dof]
                continue
            if joint.kind == "free":
                q[:, at : at + 3] += x[:, dof : dof + 3]
                at, dof = at + 3, dof + 3
            turn = slice(dof, dof + 3)
            q[:, at : at + 4] = product(q[:, at : at + 4], quaternion_of_vector(x[:, turn]))
            v[:, turn], a[:, turn] = body_rates(x[:, turn], dx[:, turn], ddx[:, turn])
        return q, v, a


def design_problem(robot: RobotModel, rate: float) -> DesignProblem:
    """The brief of a robot within its own limits."""
    low, high = robot.limits.q_low.copy(), robot.limits.q_high.copy()
    v, a = robot.limits.v.copy(), robot.limits.a.copy()
    for joint in robot.joints:
        if joint.kind == "free":
            low[joint.vadr : joint.vadr + 3], high[joint.vadr : joint.vadr + 3] = (
                -FLOATING_REACH[0],
                FLOATING_REACH[0],
            )
        if joint.kind in ("free", "ball"):
            turn = slice(
                joint.vadr + (3 if joint.kind == "free" else 0), joint.vadr + len(joint.dofs)
            )
            low[turn], high[turn] = -FLOATING_REACH[1], FLOATING_REACH[1]
            # One body axis may see the whole rate of the rotation vector, sqrt(3) of a component;
            # that vector's curvature adds less than half the squared rate to the acceleration.
            a[turn] = np.maximum(a[turn] - 0.5 * v[turn] ** 2, 0.5 * a[turn]) / np.sqrt(3)
            v[turn] /= np.sqrt(3)
    q0 = np.array(robot.mj.qpos0)
    tau = robot.limits.tau.copy()
    if robot.coupling is None:
        return DesignProblem(robot.joints, low, high, v, a, q0, rate, tau=tau)
    moving, slower = robot.coupling.independent, robot.coupling.slower
    scalar = robot.coupling.qadr[moving] >= 0
    low = np.where(scalar, robot.coupling.low, low[moving])
    high = np.where(scalar, robot.coupling.high, high[moving])
    v, a = slower * v[moving], slower * a[moving]
    q0 = robot.coupling.reference(q0)
    return DesignProblem(robot.joints, low, high, v, a, q0, rate, robot.coupling, tau[moving])
