"""Torque that is periodic in position, which effects share."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import play_position
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class PeriodicLaw:
    """tau = x F + (x Fc + F0) s - n x / (1 + x) load, x = sum_k a_k sin(k (N q + p)), by degree of
    freedom (nv,); s is the direction of friction (`friction.py`)."""

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
    acting = np.isin(np.arange(robot.nv), robot.scalar_dofs)
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
