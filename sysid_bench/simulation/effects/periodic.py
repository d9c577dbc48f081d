"""Torque that is periodic in position: of cables, eccentric gears, teeth and motors."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.effects.friction import PEAK_LOAD, friction_scale, play_position
from sysid_bench.simulation.motor_load import acting_dofs, acting_gravity, rigid_load
from sysid_bench.simulation.size import Size, check_size, joint_sizes
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class PeriodicLaw:
    """tau = x F + (x Fc + F0) s - n x / (1 + x) load, x = sum_k a_k sin(k (N q + p)), by degree of
    freedom (nv,); s is the direction of friction (`effects/friction.py`)."""

    orders: Array  # k (3,)
    amplitudes: Array  # a (3, nv)
    ratio: Array  # N
    phase: Array  # p (rad)
    force: Array  # F
    friction: Array  # Fc, F0 and the width of the transition (3, nv)
    transmitted: Array  # n: 1 or 0
    most_load: Array  # N m or N, for the choice of the step
    kind: str = "periodic"

    @cached_property
    def numbers(self) -> Array:
        """All coefficients, as steps.c reads them."""
        parts = (self.orders, self.amplitudes, self.ratio, self.phase, self.force, self.friction)
        return np.concatenate([np.ravel(x) for x in (*parts, self.transmitted)])

    @property
    def stiffness(self) -> Array:
        """Largest gradient of the torque over position (nv,)."""
        sizes, (Fc, F0, width) = np.abs(self.amplitudes), self.friction
        force = np.abs(self.force) + Fc + self.transmitted * self.most_load
        slope = self.ratio * (self.orders @ sizes) * force
        return np.asarray(slope + (sizes.sum(axis=0) * Fc + F0) / width)

    def start(self, q: Array, v: Array) -> Array:
        """Return the play's position (nv,): behind a moving joint, centred at rest."""
        return np.asarray(q - self.friction[2] * np.sign(v))

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) and the play's position after a step."""
        Fc, F0, width = self.friction
        p = play_position(state, q, width)
        a, angle = self.amplitudes, self.ratio * q + self.phase
        first, second, third = (k * angle for k in self.orders)
        x = a[0] * np.sin(first) + a[1] * np.sin(second) + a[2] * np.sin(third)
        torque = x * self.force + (x * Fc + F0) * ((q - p) / width)
        return torque - self.transmitted * x / (1.0 + x) * load, p


def periodic_law(
    robot: RobotModel,
    orders: Array,
    amplitudes: Array,
    angle: tuple[Array, Array],
    *,
    force: Array | None = None,
    friction: tuple[Array, Array, Array] | None = None,
    transmitted: Array | None = None,
) -> PeriodicLaw | None:
    """Return the law on hinges and slides; None for amplitudes (3, nv) of zero. `angle` is (N, p),
    `friction` is (Fc, F0, width), `transmitted` the largest load of torque ripple (nv,)."""
    acting = acting_dofs(robot)
    amplitudes = np.where(acting, amplitudes, 0.0)
    if not amplitudes.any():
        return None
    zero, one = np.zeros(robot.nv), np.ones(robot.nv)
    Fc, F0, width = (zero, zero, one) if friction is None else friction
    return PeriodicLaw(
        orders, amplitudes, *angle,
        force=zero if force is None else force,
        friction=np.array([Fc, F0 * acting, np.where(acting, width, 1.0)]),
        transmitted=zero if transmitted is None else one,
        most_load=zero if transmitted is None else transmitted,
    )  # fmt: skip


def rotation_dofs(robot: RobotModel) -> Array:
    """Return 1 for the degrees of freedom (nv,) of hinges, 0 for others."""
    found = np.zeros(robot.nv)
    found[[joint.vadr for joint in robot.joints if joint.kind == "hinge"]] = 1.0
    return found


# Cables and eccentric gears repeat with the joint's own angle, not with that of the motor.
@dataclass(frozen=True)
class LowHarmonics:
    """Torque F sum_k a_k sin(k (q + p)), k = 1, 2, 3, on every hinge, with F the joint's RMS
    gravity torque (at least 0.1 % of that of the most loaded joint).

    `first`, `second` and `third` are a_k, `phase` is p. On single joints of recorded arms these
    harmonics explain 12 to 86 % of the residual, some per cent of the torque.
    """

    first: Size = field(default=0.02, metadata={"unit": "%"})
    second: Size = field(default=0.01, metadata={"unit": "%"})
    third: Size = field(default=0.01, metadata={"unit": "%"})
    phase: Size = field(default=0.0, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("first", "second", "third")

    def prepare(self, robot: RobotModel) -> PeriodicLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        *sizes, phase = joint_sizes(self, robot.rows, *self.sizes, "phase")
        return periodic_law(
            robot,
            np.array([1.0, 2.0, 3.0]),
            np.array(sizes) * rotation_dofs(robot),
            (np.ones(robot.nv), phase),
            force=acting_gravity(robot),
        )


# Teeth and eccentric gears rub more at some angles than at others.
@dataclass(frozen=True)
class Periodic:
    """Torque x Fc s on every hinge and slide, x = sum_k a_k sin(k (N q + p)), k = 1, 2, 4 per motor
    revolution (Popovic, Goldenberg 1998), with s the direction of friction.

    `first`, `second` and `fourth` are a_k, 1 to 5 % each (to be verified), and less than 100 % in
    all. `ratio` is the gear ratio N (1/m on slides), `phase` is p. A joint without Coulomb friction
    is given that of `friction_scale`.
    """

    first: Size = field(default=0.05, metadata={"unit": "%"})
    second: Size = field(default=0.03, metadata={"unit": "%"})
    fourth: Size = field(default=0.01, metadata={"unit": "%"})
    ratio: Size = field(default=100.0, metadata={"unit": "1"})
    phase: Size = field(default=0.0, metadata={"unit": "rad"})
    width: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("first", "second", "fourth")
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        what = "ratio or width of the effect 'periodic-friction'"
        check_size(what, self.ratio, self.width, above=True)
        largest = [np.abs(np.asarray(x, dtype=float)).max() for x in
                   (self.first, self.second, self.fourth)]  # fmt: skip
        if not sum(largest) < 1:
            raise UsageError(
                "The sizes of the effect 'periodic-friction' are less than 100 % in all, since "
                "friction dissipates at every angle."
            )

    def prepare(self, robot: RobotModel) -> PeriodicLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        scale = friction_scale(robot)
        names = (*self.sizes, "ratio", "phase", "width")
        *sizes, ratio, phase, width = joint_sizes(self, robot.rows, *names)
        # A joint without friction of its own is given some where the periodic part is not zero.
        added = scale.missing * np.any(sizes, axis=0)
        return periodic_law(
            robot,
            np.array([1.0, 2.0, 4.0]),
            np.array(sizes),
            (ratio, phase),
            friction=(scale.coulomb, added, width),
        )


# Torque rises and falls with the angle of the motor: cogging, and flexible splines.
@dataclass(frozen=True)
class TorqueRipple:
    """Links of every hinge and slide receive (1 + x) times the motor's torque, x = sum_k a_k sin(k
    (N q + p)), k = 1, 2, 4 per motor revolution (Mattavelli, Tubiana, Zigliotto 2005).

    `first`, `second` and `fourth` are a_k: 1 to 5 % in all for motors and harmonic drives (to be
    verified). `ratio` is the gear ratio N, 50 to 160 on arms (1/m on slides), `phase` is p. Below
    10 Hz recorded arms show at most 2 %.
    """

    first: Size = field(default=0.01, metadata={"unit": "%"})
    second: Size = field(default=0.01, metadata={"unit": "%"})
    fourth: Size = field(default=0.005, metadata={"unit": "%"})
    ratio: Size = field(default=100.0, metadata={"unit": "1"})
    phase: Size = field(default=0.0, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("first", "second", "fourth")

    def __post_init__(self) -> None:
        check_size("ratio of the effect 'torque-ripple'", self.ratio, above=True)
        for size in (self.first, self.second, self.fourth):
            if not (np.abs(np.asarray(size, dtype=float)) < 0.25).all():
                raise UsageError(
                    f"Size {size!r} of the effect 'torque-ripple': give less than 25 %."
                )

    def prepare(self, robot: RobotModel) -> PeriodicLaw | None:
        """Return the force law for this robot; None without ripple."""
        *sizes, ratio, phase = joint_sizes(self, robot.rows, *self.sizes, "ratio", "phase")
        return periodic_law(
            robot,
            np.array([1.0, 2.0, 4.0]),
            np.array(sizes),
            (ratio, phase),
            transmitted=PEAK_LOAD * rigid_load(robot),
        )
