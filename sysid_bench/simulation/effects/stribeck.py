"""Stribeck friction: more Coulomb friction near standstill than in motion."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sysid_bench.models.robot import RobotModel
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

    def prepare(self, robot: RobotModel) -> Callable[[Array, Array, Array], Array]:
        """The force law of this robot."""
        scale = np.zeros(robot.nv)
        scale[robot.scalar_dofs] = self.share * _gravity_scale(robot)[robot.scalar_dofs]

        def law(t: Array, q: Array, v: Array) -> Array:
            return scale * np.exp(-((v / self.vs) ** 2)) * np.tanh(v / self.v0)

        return law


def _gravity_scale(robot: RobotModel) -> Array:
    import mujoco

    from sysid_bench.models.states import random_states

    postures = random_states(robot, 50, np.random.default_rng(0))
    data = mujoco.MjData(robot.mj)
    torque = np.empty((len(postures), robot.nv))
    for k, q in enumerate(postures.q):
        data.qpos[:] = q
        mujoco.mj_forward(robot.mj, data)
        torque[k] = data.qfrc_bias
    rms = np.sqrt((torque**2).mean(axis=0))
    return np.maximum(rms, 1e-3 * rms.max())
