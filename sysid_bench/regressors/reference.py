"""The witness: the same regressor by Pinocchio, from the paired model. Imports no other regressor.

Pinocchio's columns are per joint and its welded bodies share them; the pairing's transports X turn
them into ours, and one named permutation turns its order of the six inertias.
"""

import numpy as np
import pinocchio as pin

from sysid_bench.models.pairing import FROM_PINOCCHIO, Pairing
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Regressor, Trajectory


def pinocchio_regressor(robot: RobotModel, motion: Trajectory) -> Regressor:
    """Y (N, nv, 10 nb) by `computeJointTorqueRegressor`, rows and columns as in MuJoCo's model."""
    pairing = robot.pairing
    q = pairing.configuration(motion.q)
    v, a = pairing.rates(motion.q, motion.v, motion.a)
    Y = body_columns(joint_columns(pairing.model, q, v, a), pairing)
    return Regressor(pairing.rows_to_mujoco(motion.q, Y), robot.rows, robot.inertial_columns)


def joint_columns(model: pin.Model, q: Array, v: Array, a: Array) -> Array:
    """Y (N, nv, n_joints, 10) of a Pinocchio model in its own coordinates, our order of the ten."""
    data = model.createData()
    Y = np.empty((len(q), model.nv, 10 * (model.njoints - 1)))
    for k in range(len(q)):
        # jointTorqueRegressor is a live view of `data`, and one-dimensional when nv is 1.
        Y[k] = pin.computeJointTorqueRegressor(model, data, q[k], v[k], a[k]).reshape(model.nv, -1)
    return Y.reshape(len(q), model.nv, model.njoints - 1, 10)[..., FROM_PINOCCHIO]


def body_columns(Y: Array, pairing: Pairing) -> Array:
    """Columns per body (N, nv, 10 nb) from columns per joint (N, nv, n_joints, 10)."""
    out = np.zeros((*Y.shape[:2], len(pairing.carrier), 10))
    for b, joint in enumerate(pairing.carrier):
        if joint > 0:
            out[:, :, b] = Y[:, :, joint - 1] @ pairing.X[b]
    return out.reshape(*Y.shape[:2], -1)
