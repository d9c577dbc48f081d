"""A second, native witness: Pinocchio's own parser of the same canonical URDF text."""

import numpy as np
import pinocchio as pin

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.reference import joint_columns
from sysid_bench.spatial.inertia import transport
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Regressor, Trajectory


def native_regressor(robot: RobotModel, motion: Trajectory) -> Regressor:
    """Y (N, nv, 10 nb) of the bodies and joints that Pinocchio reads itself, matched by name.

    Raises UnsupportedError where its parser cannot serve: MJCF, a mounted payload (no text has it),
    joints that the two engines split differently.
    """
    model = _model(robot)
    q, v, a = _state(robot, model, motion)
    Y_joint = joint_columns(model, q, v, a)
    rows = _rows(robot, model)
    Y: Array = np.zeros((len(motion), robot.nv, len(robot.body_names), 10))
    for b, name in enumerate(robot.body_names):
        if not model.existBodyName(name):
            raise UnsupportedError(f"Pinocchio's parser has no body {name!r}.")
        frame = model.frames[model.getBodyId(name)]
        if frame.parentJoint > 0:
            placement = frame.placement
            X = transport(placement.rotation, placement.translation)
            Y[:, :, b] = Y_joint[:, rows, frame.parentJoint - 1] @ X
    Y = Y.reshape(*Y.shape[:2], -1)
    return Regressor(_base_force_to_world(robot, motion, Y), robot.rows, robot.inertial_columns)


def _model(robot: RobotModel) -> pin.Model:
    if robot.format != "urdf":
        raise UnsupportedError(
            "Pinocchio's MJCF parser ignores options that the model may rely on."
        )
    if robot.payload:
        raise UnsupportedError("The payload is mounted in the compiled model; no text holds it.")
    text = robot.text.decode()
    root = [pin.JointModelFreeFlyer()] if robot.floating else []
    try:
        model = pin.buildModelFromXML(text, *root)
    except (ValueError, RuntimeError) as error:
        raise UnsupportedError(
            f"Pinocchio's parser refuses it: {' '.join(str(error).split())}"
        ) from error
    if model.nv != robot.nv:
        raise UnsupportedError(
            f"Pinocchio's parser sees {model.nv} degrees of freedom, MuJoCo {robot.nv}."
        )
    model.gravity = pin.Motion(robot.tree.gravity, np.zeros(3))
    return model


def _state(robot: RobotModel, model: pin.Model, motion: Trajectory) -> tuple[Array, Array, Array]:
    q = np.tile(pin.neutral(model), (len(motion), 1))
    v, a = np.zeros((2, len(motion), model.nv))
    v_all, a_all = robot.pairing.rates(motion.q, motion.v, motion.a)
    q_all = robot.pairing.configuration(motion.q)
    for joint in robot.joints:
        native = model.joints[_joint_id(model, joint.name, joint.kind)]
        at, dof, n = native.idx_q, native.idx_v, len(joint.dofs)
        v[:, dof : dof + n] = v_all[:, joint.vadr : joint.vadr + n]
        a[:, dof : dof + n] = a_all[:, joint.vadr : joint.vadr + n]
        if joint.kind in ("hinge", "slide"):
            angle = q_all[:, joint.qadr]
            # A continuous joint is stored as cosine and sine.
            q[:, at : at + native.nq] = (
                angle[:, None]
                if native.nq == 1
                else np.stack([np.cos(angle), np.sin(angle)], axis=1)
            )
        else:
            q[:, at : at + native.nq] = q_all[:, joint.qadr : joint.qadr + native.nq]
    return q, v, a


def _joint_id(model: pin.Model, name: str, kind: str) -> int:
    name = "root_joint" if kind == "free" else name
    if not model.existJointName(name):
        raise UnsupportedError(f"Pinocchio's parser has no joint {name!r}.")
    return int(model.getJointId(name))


def _rows(robot: RobotModel, model: pin.Model) -> Array:
    """For each of our rows the row of the native model."""
    rows = np.empty(robot.nv, dtype=int)
    for joint in robot.joints:
        native = model.joints[_joint_id(model, joint.name, joint.kind)]
        rows[joint.vadr : joint.vadr + len(joint.dofs)] = native.idx_v + np.arange(len(joint.dofs))
    return rows


def _base_force_to_world(robot: RobotModel, motion: Trajectory, Y: Array) -> Array:
    for joint in robot.joints:
        if joint.kind == "free":
            R = matrix_of_quaternion(motion.q[:, joint.qadr + 3 : joint.qadr + 7])
            at = joint.vadr
            Y[:, at : at + 3] = np.einsum("nij,njc->nic", R, Y[:, at : at + 3])
    return Y
