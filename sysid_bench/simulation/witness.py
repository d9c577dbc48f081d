"""MuJoCo's own inverse dynamics, sample by sample: the second witness of Y."""

import mujoco
import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.models.warnings import kept
from sysid_bench.simulation.plant import bench_flags
from sysid_bench.types import Array, Trajectory


def inverse_torque(robot: RobotModel, motion: Trajectory) -> Array:
    """M a + bias (N, nv) from `mj_inverse`, passive and constraint forces taken out."""
    with kept():
        mj = bench_flags(robot.spec.copy().compile())
    data = mujoco.MjData(mj)
    tau = np.empty_like(motion.v)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        tau[k] = data.qfrc_inverse + data.qfrc_passive + data.qfrc_constraint
    return tau
