"""Gravity-compensation springs: balancers between links, which the identified model lacks."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.simulation.harmonics import rotation_dofs
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


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
        """Raise UsageError for impossible springs."""
        check_size("arm or length of the effect 'gravity-spring'", self.arm, self.length)
        if not (np.asarray(self.arm, dtype=float) < 1).all():
            raise UsageError(
                f"arm = {self.arm!r} of the effect 'gravity-spring': give less than 1."
            )

    def prepare(self, robot: RobotModel) -> "_SpringLaw | None":
        """Return the force law for this robot; None where springs balance nothing."""
        rows = robot.rows
        names = ("balance", "angle", "arm", "length")
        balance, *rest = (joint_size(getattr(self, name), rows, name) for name in names)
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
