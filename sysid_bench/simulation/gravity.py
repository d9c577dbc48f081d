"""RMS gravity torques of a robot: a scale for controller gains and friction effects."""

from dataclasses import replace

import mujoco
import numpy as np

from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import rigid_torque
from sysid_bench.types import Array, Trajectory

POSTURES = 50
"""Number of random postures."""


def gravity_rms(robot: RobotModel, mj: mujoco.MjModel) -> Array:
    """Return the RMS gravity torque (nv,) of a compiled model of the robot over random postures."""
    return _rms(_gravity_torque(robot, mj)[1])


def measured_gravity_rms(robot: RobotModel, mj: mujoco.MjModel) -> Array:
    """Return the RMS gravity torque on the joints with measured torque (n,), over random
    postures."""
    postures, tau = _gravity_torque(robot, mj)
    return _rms(robot.reduced(postures.q, tau))


def _gravity_torque(robot: RobotModel, mj: mujoco.MjModel) -> tuple[Trajectory, Array]:
    """Random postures and the gravity torque (N, nv) at each."""
    postures = random_states(robot, POSTURES, np.random.default_rng(0))
    still = replace(postures, v=np.zeros_like(postures.v), a=np.zeros_like(postures.a))
    return still, rigid_torque(mj, still)


def _rms(tau: Array) -> Array:
    return np.asarray(np.sqrt((tau**2).mean(axis=0)))
