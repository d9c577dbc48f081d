"""How large a robot's gravity torques are: a scale for gains and effects."""

from dataclasses import replace

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.states import random_states
from sysid_bench.simulation.inverse import rigid_torque
from sysid_bench.types import Array

POSTURES = 50


def gravity_rms(robot: RobotModel, mj: mujoco.MjModel) -> Array:
    """RMS gravity torque (nv,) of a compiled model of the robot over random postures."""
    postures = random_states(robot, POSTURES, np.random.default_rng(0))
    still = replace(postures, v=np.zeros_like(postures.v), a=np.zeros_like(postures.a))
    return np.sqrt((rigid_torque(mj, still) ** 2).mean(axis=0))
