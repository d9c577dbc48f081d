"""The witness: the same regressor by Pinocchio, from the paired model. Imports no other regressor.

Pinocchio's columns are per joint and its welded bodies share them; the pairing's transports X turn
them into ours, and one named permutation turns its order of the six inertias.
"""

import mujoco
import numpy as np
import pinocchio as pin

from sysid_bench.models.coupling.equalities import ends_of, sums_of
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


def reduced_regressor(robot: RobotModel, motion: Trajectory, tree: Regressor) -> Regressor:
    """`pinocchio_regressor` on the independent joints of a coupled robot; the joints that follow
    are resolved from Pinocchio's own Jacobians, never by its mimic models, which it has no
    regressor for."""
    coupling = robot.coupling
    assert coupling is not None
    J = _closure_jacobian(robot, motion)
    moving, following = coupling.independent, coupling.dependent
    Y = tree.Y[:, moving]
    for k in range(len(motion)):
        F = -np.linalg.lstsq(J[k][:, following], J[k][:, moving], rcond=None)[0]
        Y[k] += np.einsum("ij,ip->jp", F, tree.Y[k, following])
    return Regressor(Y, robot.torque_rows, tree.columns)


def _closure_jacobian(robot: RobotModel, motion: Trajectory) -> Array:
    """J (N, m, nv) of a robot's equalities, J v = 0 at closed q: of loops by the Jacobians of the
    joints that carry their ends, in world axes."""
    pairing, mj = robot.pairing, robot.mj
    data = pairing.model.createData()
    loops = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    rows = []
    for q, x in zip(pairing.configuration(motion.q), motion.q, strict=True):
        pin.computeJointJacobians(pairing.model, data, q)
        parts = [
            _loop_rows(robot, data, e) if int(mj.eq_type[e]) in loops else _sum_rows(robot, e, x)
            for e in range(mj.neq)
        ]
        rows.append(np.concatenate(parts))
    return np.stack(rows)


def _loop_rows(robot: RobotModel, data: pin.Data, e: int) -> Array:
    """[v; w] (6, nv) of one end against the other; of a connect the first three rows."""
    mj, pairing = robot.mj, robot.pairing
    ends = []
    for body, p, _ in ends_of(mj, e):
        twist = np.zeros((6, robot.nv))
        joint = int(pairing.carrier[body - 1]) if body > 0 else 0
        if joint > 0:
            R = data.oMi[joint].rotation
            arm = R @ pairing.poses[body - 1].act(p)
            twist = pin.getJointJacobian(
                pairing.model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            ).copy()
            twist[:3] -= np.cross(arm, twist[3:].T).T
        ends.append(twist)
    rigid = int(mj.eq_type[e]) == int(mujoco.mjtEq.mjEQ_WELD) and mj.eq_data[e, 10] > 0
    return (ends[0] - ends[1])[: 6 if rigid else 3]


def _sum_rows(robot: RobotModel, e: int, q: Array) -> Array:
    """The row (1, nv) of a joint or tendon equality at q (nq,)."""
    row, place = np.zeros((1, robot.nv)), {joint.vadr: joint.qadr for joint in robot.joints}
    first, second = sums_of(robot.mj, e)
    at = sum(c * (q[place[d]] - robot.mj.qpos0[place[d]]) for d, c in second.items())
    slope = sum(k * c * at ** (k - 1) for k, c in enumerate(robot.mj.eq_data[e, :5]) if k)
    for dof, coefficient in first.items():
        row[0, dof] += coefficient
    for dof, coefficient in second.items():
        row[0, dof] -= slope * coefficient
    return row


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
