"""Inertia and load as the motors see them, for which controllers are designed and effects sized."""

from dataclasses import replace

import mujoco
import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import rigid_torque
from sysid_bench.simulation.plant import Plant
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


def motor_values(robot: RobotModel, values: Array, power: int) -> Array:
    """Return values (nv,) of joints referred to the motors (n,) at the reference posture.

    By |G| for forces (power 1), by its square for damping and inertia (power 2).
    """
    if robot.coupling is None:
        return values
    q = robot.coupling.default_closure(np.array(robot.mj.qpos0))
    return np.asarray(values @ np.abs(robot.coupling.G(q[None])[0]) ** power)


def motor_inertia(plant: Plant) -> Array:
    """Return the diagonal of the mass matrix (n,) at the reference posture, kg m^2 or kg."""
    return np.diag(mass_matrix(plant.contact_free_model, plant.robot.coupling)).copy()


def mass_matrix(mj: mujoco.MjModel, coupling: Coupling | None = None) -> Array:
    """Return the mass matrix M (n, n) at the reference posture; G^T M G with a coupling."""
    data = mujoco.MjData(mj)
    if coupling is not None:
        data.qpos[:] = coupling.default_closure(np.array(mj.qpos0))
    mujoco.mj_forward(mj, data)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_fullM(mj, data, M)
    if coupling is None:
        return M
    G = coupling.G(data.qpos[None])[0]
    return np.asarray(G.T @ M @ G)


def motor_load(plant: Plant) -> Array:
    """Return the RMS gravity torque plus friction at half the velocity limit (n,), N m or N."""
    robot, terms = plant.robot, plant.terms
    load = measured_gravity_rms(robot, plant.contact_free_model)
    moving = terms.viscous * 0.5 * robot.limits.v
    for force in (moving, terms.coulomb, np.abs(terms.offset)):
        load = load + motor_values(robot, force, 1)
    return load


def acting_dofs(robot: RobotModel) -> Array:
    """Return True for the degrees of freedom (nv,) of hinges and slides, on which effects act."""
    return np.isin(np.arange(robot.nv), robot.scalar_dofs)


def acting_gravity(robot: RobotModel) -> Array:
    """Return the RMS gravity torque (nv,) of hinges and slides that sizes of effects refer to, at
    least 0.1 % of that of the most loaded joint; zero for other joints."""
    gravity = gravity_rms(robot, robot.mj)
    return np.where(acting_dofs(robot), np.maximum(gravity, 1e-3 * gravity.max()), 0.0)


def rigid_load(robot: RobotModel) -> Array:
    """Return the root sum of squares (nv,) of RMS gravity torque and torque of half the
    acceleration limit, N m or N."""
    limit = np.where(np.isfinite(robot.limits.a), robot.limits.a, 0.0)
    inertia = np.diag(mass_matrix(robot.mj))
    return np.asarray(np.hypot(gravity_rms(robot, robot.mj), 0.5 * inertia * limit))
