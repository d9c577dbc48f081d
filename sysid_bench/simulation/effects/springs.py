"""Springs: balancers between links, dress packs of cables, and elastic transmissions."""

from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.effects.friction import play_position
from sysid_bench.simulation.effects.periodic import rotation_dofs
from sysid_bench.simulation.elastic_drives import ElasticDrives
from sysid_bench.simulation.motor_load import acting_dofs, gravity_rms, mass_matrix, rigid_load
from sysid_bench.simulation.size import Size, check_size, effect_size, joint_size, joint_sizes
from sysid_bench.types import Array


# Balancers between links, which the identified model lacks.
@dataclass(frozen=True)
class GravitySpring:
    """Spring from a point at the distance a of a hinge to one at b (Arakelian, Ghazaryan 2008):
    torque F sin(x) (1 - c / l), l = sqrt(1 + r^2 - 2 r cos(x)), x = q - `angle`, on every hinge.

    F is the share `balance` of sqrt(2) times the joint's RMS gravity torque: balancers of heavy
    arms carry 50 to 100 % of the shoulder's load, and other joints have none (to be verified).
    `arm` is r = a / b, `length` is c, the relaxed length over b.
    """

    balance: Size = field(default=0.5, metadata={"unit": "%"})
    angle: Size = field(default=0.0, metadata={"unit": "rad"})
    arm: Size = field(default=0.3, metadata={"unit": "1"})
    length: Size = field(default=0.5, metadata={"unit": "1"})
    sizes: ClassVar[tuple[str, ...]] = ("balance",)

    def __post_init__(self) -> None:
        check_size("arm or length of the effect 'gravity-spring'", self.arm, self.length)
        if not (np.asarray(self.arm, dtype=float) < 1).all():
            raise UsageError(
                f"arm = {self.arm!r} of the effect 'gravity-spring': give less than 1."
            )

    def prepare(self, robot: RobotModel) -> "_SpringLaw | None":
        """Return the force law for this robot; None where springs balance nothing."""
        names = ("balance", "angle", "arm", "length")
        balance, *rest = joint_sizes(self, robot.rows, *names)
        force = balance * np.sqrt(2.0) * gravity_rms(robot, robot.mj) * rotation_dofs(robot)
        return _SpringLaw(np.concatenate([force, *rest])) if balance.any() else None


@dataclass(frozen=True, eq=False)
class _SpringLaw:
    """Force law of gravity springs; `numbers` (4 nv,) are F, angle, arm, length."""

    numbers: Array
    kind: str = "gravity spring"

    @property
    def stiffness(self) -> Array:
        """Gradient of the torque over position, about (nv,)."""
        F, _, arm, length = self.numbers.reshape(4, -1)
        return np.asarray(np.abs(F) * (1 + length / (1 - arm)))

    def start(self, q: Array, v: Array) -> Array:
        """Return no states (0,)."""
        return np.zeros(0)

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) at q."""
        F, angle, arm, length = self.numbers.reshape(4, -1)
        x = q - angle
        return F * np.sin(x) * (1 - length / np.sqrt(1 + arm * arm - 2 * arm * np.cos(x))), state


# Dress packs bend and rub as joints move.
@dataclass(frozen=True)
class Cables:
    """Torque K (q - q0) + H (q - p) / w on every hinge and slide: a spring about the centre of the
    joint's range, and hysteresis by play of the half width w (`effects/friction.py`).

    K times half the range (at most half a turn) is the share `bending` of the joint's typical load
    (RMS gravity torque, and torque of half the acceleration limit), H the share `hysteresis`.
    Dress packs of arms take 1 to 10 N m (to be verified), 1 to 5 % of it. `width` is w.
    """

    bending: Size = field(default=0.03, metadata={"unit": "%"})
    hysteresis: Size = field(default=0.01, metadata={"unit": "%"})
    width: Size = field(default=0.05, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("bending", "hysteresis")
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_size("Size of the effect 'cables'", self.bending, self.hysteresis)
        check_size("width of the effect 'cables'", self.width, above=True)

    def prepare(self, robot: RobotModel) -> "_CableLaw | None":
        """Return the force law for this robot; None for sizes of zero."""
        names = ("bending", "hysteresis", "width")
        bending, hysteresis, width = joint_sizes(self, robot.rows, *names)
        if not (bending.any() or hysteresis.any()):
            return None
        load = np.where(acting_dofs(robot), rigid_load(robot), 0.0)
        low, high = robot.limits.q_low, robot.limits.q_high
        limited = np.isfinite(low) & np.isfinite(high) & (high > low)
        low, high = np.where(limited, low, -np.pi), np.where(limited, high, np.pi)
        half, centre = np.minimum(0.5 * (high - low), np.pi), 0.5 * (low + high)
        numbers = [bending * load / half, centre, hysteresis * load, width]
        return _CableLaw(np.concatenate(numbers))


@dataclass(frozen=True, eq=False)
class _CableLaw:
    """Force law of cables; `numbers` (4 nv,) are K, q0, H, w."""

    numbers: Array
    kind: str = "cables"

    @property
    def stiffness(self) -> Array:
        """Stiffness before the cables rub (nv,)."""
        K, _, H, width = self.numbers.reshape(4, -1)
        return np.asarray(K + H / width)

    def start(self, q: Array, v: Array) -> Array:
        """Return the play's position (nv,): behind a moving joint, centred at rest."""
        return np.asarray(q - self.numbers.reshape(4, -1)[3] * np.sign(v))

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) and the play's position after a step."""
        K, centre, H, width = self.numbers.reshape(4, -1)
        p = play_position(state, q, width)
        return K * (q - centre) + H * ((q - p) / width), p


LEAST_LOAD: Final = 0.01
"""Smallest load of a joint that a transmission is made for, over that of the most loaded joint."""

LEAST_ROTOR: Final = 1e-3
"""Rotor inertia over the joint's diagonal element of the mass matrix, below which a rotor counts as
one without inertia: it would oscillate more than 30 times faster than its joint."""


@dataclass(frozen=True)
class ElasticJoints:
    """Elastic transmission of every motor (Spong 1987), see `elastic_drives.py`.

    `stiffness` (N m/rad, N/m) is one number or one per motor; without it K is the joint's
    typical load, at least 1 % of that of the most loaded joint of its kind (hinges, slides), over
    `windup`: transmissions of arms have 5e3 to 5e4 N m/rad and wind up by 0.3 to 2 mrad. The
    typical load is the RMS gravity torque over random postures, and the torque of half the
    acceleration limit. `damping` is D over K (s). `gap` is half the backlash; published values of
    the whole are 0.1 to 1 mrad (assumed), those of industrial gears below 0.3 mrad (1 arcmin, as
    data sheets state). The rotors have the armature of the robot; a motor without any has no gap,
    which it would cross in no time, again and again; one below LEAST_ROTOR
    counts as none. `encoders` are on the "motor" or the "link".
    """

    stiffness: Size | None = None
    windup: Size = field(default=1e-3, metadata={"unit": "rad|m"})
    damping: Size = field(default=1e-4, metadata={"unit": "s"})
    gap: Size = field(default=0.0, metadata={"unit": "rad|m"})
    encoders: str = "motor"
    sizes: ClassVar[tuple[str, ...]] = ("windup", "gap")
    vanishes_at_rest: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_size("Size of 'elastic-joints'", self.windup, self.damping, self.gap)
        if self.stiffness is not None:
            check_size("stiffness of 'elastic-joints'", self.stiffness, above=True)
        if self.encoders not in ("motor", "link"):
            raise unknown_name("side of encoders", self.encoders, ("motor", "link"))

    @staticmethod
    def size_names(robot: RobotModel) -> tuple[str, ...]:
        """Return the names of the motors that a list of sizes is for."""
        return robot.torque_rows

    def prepare(self, robot: RobotModel) -> ElasticDrives | None:
        """Return the transmission; None for rigid ones, of no windup and gap.

        Raises UnsupportedError for coupled joints.
        """
        names = robot.torque_rows
        windup, damping, gap = joint_sizes(self, names, "windup", "damping", "gap")
        soft = effect_size(windup, "windup")
        if self.stiffness is None and soft is None:
            return None
        if robot.coupling is not None:
            raise UnsupportedError(
                f"{robot.name} has coupled joints, whose motors cannot be elastic here."
            )
        dofs = np.asarray(robot.torque_dofs)
        if self.stiffness is None:
            K = least_load(robot, rigid_load(robot))[dofs] / soft
        else:
            K = joint_size(self.stiffness, names, "stiffness")
        inertia = robot.joint_terms.armature[dofs]
        inertia = np.where(
            inertia < LEAST_ROTOR * np.diag(mass_matrix(robot.mj))[dofs], 0.0, inertia
        )
        crossed = np.where(inertia > 0, gap, 0.0)
        return ElasticDrives(K, damping * K, crossed, inertia, self.encoders == "motor")


def least_load(robot: RobotModel, load: Array) -> Array:
    """Return loads (nv,), N m or N, raised to LEAST_LOAD of the largest one of their kind of joint:
    newtons of slides do not compare with newton metres."""
    raised = load.copy()
    for kind in ("hinge", "slide"):
        same = [joint.vadr for joint in robot.joints if joint.kind == kind]
        raised[same] = np.maximum(load[same], LEAST_LOAD * load[same].max(initial=0.0))
    return raised
