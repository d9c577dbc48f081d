"""MuJoCo's own inverse dynamics, sample by sample: the second witness of Y."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from sysid_bench.models.checks.mujoco_warnings import recorded_warnings
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.plant import contact_free_flags
from sysid_bench.types import Array, Trajectory

_BIT: Final = mujoco.mjtDisableBit


def inverse_torque(robot: RobotModel, motion: Trajectory) -> Array:
    """M a + bias (N, nv) from `mj_inverse`, passive and constraint forces taken out."""
    with recorded_warnings():
        mj = contact_free_flags(robot.spec.copy().compile())
    # Off, not subtracted: a damping of 1e11, which holds a joint still, would drown the rest.
    for bit in (_BIT.mjDSBL_SPRING, _BIT.mjDSBL_DAMPER, _BIT.mjDSBL_FRICTIONLOSS):
        mj.opt.disableflags |= int(bit)
    data = mujoco.MjData(mj)
    tau = np.empty_like(motion.v)
    for k in range(len(motion)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(mj, data)
        tau[k] = data.qfrc_inverse + data.qfrc_passive + data.qfrc_constraint
    return tau


@dataclass(frozen=True, eq=False)
class ConstrainedTorque:
    """What MuJoCo says of closed chains along a motion: `tau` (N, n) on the independent joints, and
    the largest `violation` (rad, m) of any constraint."""

    tau: Array
    violation: float


def constrained_torque(robot: RobotModel, motion: Trajectory) -> ConstrainedTorque:
    """The torques with which the independent joints alone make the motion: M a + bias less the
    constraint forces that hold the joints that follow, by MuJoCo's own constraint Jacobian."""
    coupling = robot.coupling
    assert coupling is not None
    with recorded_warnings():
        mj = contact_free_flags(robot.spec.copy().compile())
    mj.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    mj.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data = mujoco.MjData(mj)
    tree = inverse_torque(robot, motion)
    tau, violation = tree[:, coupling.independent], 0.0
    for k in range(len(motion)):
        data.qpos[:] = motion.q[k]
        mujoco.mj_fwdPosition(mj, data)
        closes = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        J = data.efc_J.reshape(data.nefc, mj.nv)[closes]
        violation = max(violation, float(np.abs(data.efc_pos[closes]).max(initial=0.0)))
        force = np.linalg.lstsq(J[:, coupling.dependent].T, tree[k, coupling.dependent])[0]
        tau[k] -= J[:, coupling.independent].T @ force
    return ConstrainedTorque(tau, violation)
