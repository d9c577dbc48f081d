"""Reference regressor by Pinocchio, built from the paired model, independently of our kernels.

Pinocchio has ten columns per joint, shared by all bodies welded behind it. The pairing's parameter
transports X (10, 10) give the columns of each body, and one permutation its order of the inertias.
"""

import mujoco
import numpy as np
import pinocchio as pin

from sysid_bench.models.coupling.equalities import closure_frames, coupled_terms
from sysid_bench.models.pairing import FROM_PINOCCHIO, Pairing
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Regressor, Trajectory


def pinocchio_regressor(robot: RobotModel, motion: Trajectory) -> Regressor:
    """Return Y (N, nv, 10 nb) by `computeJointTorqueRegressor`, rows and columns in MuJoCo's order.

    A body's parameters are m, m c and the inertia about its origin, in body axes.
    """
    pairing = robot.pairing
    q = pairing.positions_to_pinocchio(motion.q)
    v, a = pairing.rates(motion.q, motion.v, motion.a)
    Y = body_columns(joint_columns(pairing.model, q, v, a), pairing)
    return Regressor(pairing.rows_to_mujoco(motion.q, Y), robot.rows, robot.inertial_columns)


def reduced_regressor(robot: RobotModel, motion: Trajectory, tree: Regressor) -> Regressor:
    """Return the regressor (N, n, 10 nb) of a coupled robot's independent joints; `tree` is that of
    `pinocchio_regressor`.

    Dependent rates are solved from constraint Jacobians by Pinocchio, independently of
    `models.coupling`. Pinocchio's mimic joints are not used: it has no regressor for them.
    """
    coupling = robot.coupling
    assert coupling is not None
    # Constraint Jacobian J (N, m, nv), J v = 0 at closed q; rows of loops come from the Jacobians
    # of the joints that carry their two ends, in world axes.
    pairing, mj = robot.pairing, robot.mj
    data = pairing.model.createData()
    loops = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    rows = []
    for q, x in zip(pairing.positions_to_pinocchio(motion.q), motion.q, strict=True):
        pin.computeJointJacobians(pairing.model, data, q)
        parts = [
            _loop_rows(robot, data, e) if int(mj.eq_type[e]) in loops else _sum_rows(robot, e, x)
            for e in range(mj.neq)
        ]
        rows.append(np.concatenate(parts))
    # Power is the same in both engines: columns of J change as rows of torques do.
    J = pairing.rows_to_mujoco(motion.q, np.stack(rows).swapaxes(1, 2))
    J = J.swapaxes(1, 2)
    moving, following = coupling.independent, coupling.dependent
    Y = tree.Y[:, moving]
    for k in range(len(motion)):
        # Loops have redundant rows: least squares takes any consistent number of them.
        F = -np.linalg.lstsq(J[k][:, following], J[k][:, moving], rcond=None)[0]
        Y[k] += np.einsum("ij,ip->jp", F, tree.Y[k, following])
    return Regressor(Y, robot.torque_rows, tree.columns)


def _loop_rows(robot: RobotModel, data: pin.Data, e: int) -> Array:
    """Relative twist [v; w] (6, nv) of the two ends of a loop; of a connect, v (3, nv) alone."""
    mj, pairing = robot.mj, robot.pairing
    ends = []
    for body, p, _ in closure_frames(mj, e):
        twist = np.zeros((6, robot.nv))
        joint = int(pairing.carrier[body - 1]) if body > 0 else 0
        if joint > 0:
            R = data.oMi[joint].rotation
            arm = R @ pairing.poses[body - 1].act(p)
            twist = pin.getJointJacobian(
                pairing.model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            ).copy()
            # Velocity of the loop's end, not of the joint's origin: v - arm x w.
            twist[:3] -= np.cross(arm, twist[3:].T).T
        ends.append(twist)
    rigid = int(mj.eq_type[e]) == int(mujoco.mjtEq.mjEQ_WELD) and mj.eq_data[e, 10] > 0
    return (ends[0] - ends[1])[: 6 if rigid else 3]


def _sum_rows(robot: RobotModel, e: int, q: Array) -> Array:
    """Row (1, nv) of a joint or tendon equality at q (nq,): y = polynomial(x) in MuJoCo."""
    row, qadr = np.zeros((1, robot.nv)), {joint.vadr: joint.qadr for joint in robot.joints}
    first, second = coupled_terms(robot.mj, e)
    x = sum(c * (q[qadr[d]] - robot.mj.qpos0[qadr[d]]) for d, c in second.items())
    slope = sum(k * c * x ** (k - 1) for k, c in enumerate(robot.mj.eq_data[e, :5]) if k)
    for dof, coefficient in first.items():
        row[0, dof] += coefficient
    for dof, coefficient in second.items():
        row[0, dof] -= slope * coefficient
    return row


def joint_columns(model: pin.Model, q: Array, v: Array, a: Array) -> Array:
    """Return Y (N, nv, n_joints, 10) of a Pinocchio model in its own coordinates, with the ten
    parameters in our order."""
    data = model.createData()
    Y = np.empty((len(q), model.nv, 10 * (model.njoints - 1)))
    for k in range(len(q)):
        # jointTorqueRegressor is a live view of `data`, and one-dimensional when nv is 1.
        Y[k] = pin.computeJointTorqueRegressor(model, data, q[k], v[k], a[k]).reshape(model.nv, -1)
    return Y.reshape(len(q), model.nv, model.njoints - 1, 10)[..., FROM_PINOCCHIO]


def body_columns(Y: Array, pairing: Pairing) -> Array:
    """Return columns per body (N, nv, 10 nb) from columns per joint (N, nv, n_joints, 10)."""
    out = np.zeros((*Y.shape[:2], len(pairing.carrier), 10))
    for b, joint in enumerate(pairing.carrier):
        if joint > 0:
            out[:, :, b] = Y[:, :, joint - 1] @ pairing.X[b]
    return out.reshape(*Y.shape[:2], -1)
