"""Stribeck friction: more Coulomb friction near standstill than in motion."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.types import Array


@dataclass(frozen=True)
class Stribeck:
    """Adds F exp(-(v/vs)^2) tanh(v/v0) to every hinge and slide (Armstrong-Helouvry 1991, eq. 3.1).

    F is `share` of a joint's gravity torque scale, so that one setting fits small and large arms:
    the RMS gravity torque of the joint over random postures, floored at 0.1 % of the largest.
    """

    share: float = field(default=0.1, metadata={"unit": "%"})
    vs: float = field(default=0.1, metadata={"unit": "rad|m"})  # per second
    v0: float = field(default=0.005, metadata={"unit": "rad|m"})  # per second

    def prepare(self, robot: RobotModel) -> "StribeckLaw":
        """The force law of this robot."""
        gravity = gravity_rms(robot, robot.mj)
        gravity = np.maximum(gravity, 1e-3 * gravity.max())
        scale = np.zeros(robot.nv)
        scale[robot.scalar_dofs] = self.share * gravity[robot.scalar_dofs]
        return StribeckLaw(np.concatenate([scale, [self.vs, self.v0]]))


@dataclass(frozen=True, eq=False)
class StribeckLaw:
    """`numbers`: F (nv,), vs, v0."""

    numbers: Array
    kind: str = "stribeck"

    def __call__(self, t: Array, q: Array, v: Array) -> Array:
        """Torque (..., nv)."""
        scale, (vs, v0) = self.numbers[:-2], self.numbers[-2:]
        return scale * np.exp(-((v / vs) ** 2)) * np.tanh(v / v0)
