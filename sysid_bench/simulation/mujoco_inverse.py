"""Reference torques by MuJoCo's inverse dynamics, sample by sample."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from sysid_bench.models.model_checks import recorded_warnings
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.plant import contact_free
from sysid_bench.types import Array, Trajectory

_BIT: Final = mujoco.mjtDisableBit


def inverse_torque(robot: RobotModel, motion: Trajectory) -> Array:
    """Return M a + bias (N, nv) by `mj_inverse`, without passive and constraint forces."""
    with recorded_warnings():
        mj = contact_free(robot.spec.copy().compile())
    # Passive forces are disabled, not subtracted: the damping of 1e11 that some models use to fix a
    # joint would cancel all digits.
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
class _IndependentTorque:
    """Inverse dynamics of closed chains along a motion: `tau` (N, n) on the independent joints, and
    the largest constraint `violation` (rad, m)."""

    tau: Array
    violation: float


def independent_torque(robot: RobotModel, motion: Trajectory) -> _IndependentTorque:
    """Return the torques of a motion that the independent joints alone drive: M a + bias - J^T f.

    The constraint forces f follow from zero torque on the dependent joints, with MuJoCo's
    constraint Jacobian J.
    """
    coupling = robot.coupling
    assert coupling is not None
    with recorded_warnings():
        mj = contact_free(robot.spec.copy().compile())
    mj.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    mj.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    data = mujoco.MjData(mj)
    tree = inverse_torque(robot, motion)
    tau, violation = tree[:, coupling.independent], 0.0
    for k in range(len(motion)):
        data.qpos[:] = motion.q[k]
        mujoco.mj_fwdPosition(mj, data)
        equality = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        J = data.efc_J.reshape(data.nefc, mj.nv)[equality]
        violation = max(violation, float(np.abs(data.efc_pos[equality]).max(initial=0.0)))
        force = np.linalg.lstsq(J[:, coupling.dependent].T, tree[k, coupling.dependent])[0]
        tau[k] -= J[:, coupling.independent].T @ force
    return _IndependentTorque(tau, violation)
