"""The second engine that our regressor is checked against.

Pinocchio, where it is installed; elsewhere (it has no wheel for Windows) MuJoCo's recursive
Newton-Euler algorithm, which shares no code with ours: torques are linear in the parameters, so
that those of ten point masses on a body give the ten columns of its parameters.
"""

from collections.abc import Callable, Sequence
from copy import copy
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.simulation.inverse import independent_rows
from sysid_bench.spatial import phi_of
from sysid_bench.types import Array, Regressor, Trajectory

ENGINES: Final = {"pinocchio": "Pinocchio", "mujoco": "MuJoCo's own inverse dynamics"}
"""Second engines, in words."""

WITHOUT: Final = "Pinocchio is not installed: the second engine is MuJoCo's own inverse dynamics."

# phi is of second degree in the position of a point mass; no polynomial of second degree other
# than zero vanishes at these ten.
_POINTS: Final = np.array(
    [p for p in product((0.0, 1.0), repeat=3) if sum(p) <= 2] + [*-np.eye(3)], float
)
_PHI: Final = np.array([phi_of(1.0, point, np.zeros((3, 3))) for point in _POINTS])


def second_engine() -> str:
    """Return the second engine of this installation, a key of ENGINES."""
    return "mujoco" if find_spec("pinocchio") is None else "pinocchio"


def _pinocchio(module: str) -> Any:
    """The module of the reference regressors that loads Pinocchio."""
    return import_module(f"sysid_bench.regressors.{module}")


def reference_regressor(robot: RobotModel, motion: Trajectory) -> Regressor:
    """Return Y (N, nv, 10 nb) by the second engine, rows and columns in our order."""
    if second_engine() == "pinocchio":
        made: Regressor = _pinocchio("pinocchio").pinocchio_regressor(robot, motion)
        return made

    def torque(mj: mujoco.MjModel, data: mujoco.MjData) -> Array:
        tau = np.empty(mj.nv)
        mujoco.mj_rne(mj, data, 1, tau)
        return tau

    Y = _columns(robot, range(len(robot.body_names)), motion, torque)
    return Regressor(Y, robot.rows, robot.inertial_columns)


def reduced_reference(robot: RobotModel, motion: Trajectory) -> Array:
    """Return the regressor (N, n, 10 nb) of a coupled robot's independent joints, by constraint
    Jacobians of the second engine."""
    tree = reference_regressor(robot, motion)
    if second_engine() == "pinocchio":
        return np.asarray(_pinocchio("pinocchio").reduced_regressor(robot, motion, tree).Y)
    return independent_rows(robot, motion, tree.Y)[0]


def native_regressor(robot: RobotModel, motion: Trajectory) -> Array:
    """Return Y of the model that Pinocchio's own parser reads; raises UnsupportedError without
    it."""
    if second_engine() != "pinocchio":
        raise UnsupportedError(WITHOUT)
    return np.asarray(_pinocchio("pinocchio_urdf").urdf_regressor(robot, motion).Y)


def wrench_reference(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory, base: str
) -> Regressor:
    """Return Y_n (N, 6, p), the wrench [n; f] at the body `base`, the first distal to a sensor, in
    its axes, by the second engine."""
    if second_engine() == "pinocchio":
        module = _pinocchio("pinocchio_wrench")
        made: Regressor = module.pinocchio_wrench_regressor(robot, cut, motion, base)[0]
        return made
    b = robot.body_names.index(base) + 1  # MuJoCo counts the world

    def wrench(mj: mujoco.MjModel, data: mujoco.MjData) -> Array:
        mujoco.mj_rnePostConstraint(mj, data)
        moment, force = data.cfrc_int[b, :3], data.cfrc_int[b, 3:]
        # MuJoCo states it in world axes about the centre of mass of the whole tree.
        arm = data.subtree_com[mj.body_rootid[b]] - data.xpos[b]
        R_wb = data.xmat[b].reshape(3, 3)
        return np.concatenate([R_wb.T @ (moment + np.cross(arm, force)), R_wb.T @ force])

    Y = _columns(robot, cut.bodies, motion, wrench)
    rows = tuple(f"{base}.{row.rpartition('.')[2]}" for row in cut.rows)
    columns = tuple(column for body in cut.bodies for column in robot.bodies[body].columns)
    return Regressor(Y, rows, columns)


def _columns(
    robot: RobotModel,
    bodies: Sequence[int],
    motion: Trajectory,
    measure: Callable[[mujoco.MjModel, mujoco.MjData], Array],
) -> Array:
    """Columns (N, m, 10 len(bodies)) of what is measured (m,) on the model in motion, with point
    masses of 1 kg in place of its bodies, one at a time."""
    mj = copy(robot.mj)
    mj.body_mass[:], mj.body_inertia[:], mj.body_iquat[:] = 0.0, 0.0, (1.0, 0.0, 0.0, 0.0)
    mj.body_sameframe[:] = 0  # else MuJoCo leaves inertial frames where they were
    data, parts = mujoco.MjData(mj), []
    for b in bodies:
        mj.body_mass[b + 1] = 1.0
        values = []
        for point in _POINTS:
            mj.body_ipos[b + 1] = point
            for k in range(len(motion)):
                data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
                mujoco.mj_kinematics(mj, data)
                mujoco.mj_comPos(mj, data)
                mujoco.mj_comVel(mj, data)
                values.append(measure(mj, data))
        mj.body_mass[b + 1] = 0.0
        # Y phi_i of all points: Y = (phi^-1 [Y phi_i])', with phi (10, 10) of small whole numbers
        stacked = np.array(values).reshape(len(_POINTS), len(motion), -1)
        parts.append(np.moveaxis(np.tensordot(np.linalg.inv(_PHI), stacked, axes=1), 0, -1))
    return np.concatenate(parts, axis=-1)
