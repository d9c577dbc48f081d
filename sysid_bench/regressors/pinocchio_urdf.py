"""Second reference regressor: Pinocchio's own parser reads the canonical URDF text.

Links and joints are renamed first, so that no name has a special meaning to the parser. Two further
changes leave the motion as it is: a floating joint at the world becomes the root joint, and a
planar joint becomes two slides and a hinge, as in MuJoCo.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.urdf import PLANAR_PARTS
from sysid_bench.models.xml_file import parse_xml
from sysid_bench.regressors.pinocchio import joint_columns
from sysid_bench.spatial import inertia_transform
from sysid_bench.types import Array, Regressor, Trajectory


@dataclass(frozen=True, eq=False)
class _UrdfModel:
    """Pinocchio's model, and the names in it of our bodies and joints."""

    model: pin.Model
    bodies: dict[str, str]
    joints: dict[str, str]

    def body(self, name: str) -> pin.Frame:
        """Frame of a body; raises UnsupportedError if the parser dropped it."""
        urdf_name = self.bodies.get(name, "")
        if not self.model.existBodyName(urdf_name):
            raise UnsupportedError(f"Pinocchio's parser has no body {name!r}.")
        return self.model.frames[self.model.getBodyId(urdf_name)]

    def joint(self, name: str, kind: str) -> pin.JointModel:
        """Joint model; raises UnsupportedError if the parser dropped it."""
        # Pinocchio calls the joint of a floating base so.
        urdf_name = "root_joint" if kind == "free" else self.joints.get(name, "")
        if not self.model.existJointName(urdf_name):
            raise UnsupportedError(f"Pinocchio's parser has no joint {name!r}.")
        return self.model.joints[self.model.getJointId(urdf_name)]


def urdf_regressor(robot: RobotModel, motion: Trajectory) -> Regressor:
    """Return Y (N, nv, 10 nb) of the model that Pinocchio's URDF parser reads, rows and columns in
    MuJoCo's order.

    Raises UnsupportedError for an MJCF robot, a mounted payload (which is in no URDF text) and
    joints that the parser does not support.
    """
    native = _urdf_model(robot)
    q, v, a = _state(robot, native, motion)
    Y_joint = joint_columns(native.model, q, v, a)
    # Row of Pinocchio's model for each of our rows.
    rows = np.empty(robot.nv, dtype=int)
    for joint in robot.joints:
        target = native.joint(joint.name, joint.kind)
        rows[joint.vadr : joint.vadr + len(joint.dofs)] = target.idx_v + np.arange(len(joint.dofs))
    Y: Array = np.zeros((len(motion), robot.nv, len(robot.body_names), 10))
    for b, name in enumerate(robot.body_names):
        frame = native.body(name)
        if frame.parentJoint > 0:
            placement = frame.placement
            X = inertia_transform(placement.rotation, placement.translation)
            Y[:, :, b] = Y_joint[:, rows, frame.parentJoint - 1] @ X
    Y = Y.reshape(*Y.shape[:2], -1)
    # Pinocchio's force on a floating base is in body axes.
    Y = robot.pairing.rows_to_mujoco(motion.q, Y)
    return Regressor(Y, robot.rows, robot.inertial_columns)


def _urdf_model(robot: RobotModel) -> _UrdfModel:
    if robot.format != "urdf":
        raise UnsupportedError(
            "Pinocchio's MJCF parser ignores options that the model may rely on."
        )
    if robot.payload:
        raise UnsupportedError("The payload is mounted in the compiled model, not in the URDF.")
    text = parse_xml(robot.text, robot.name)
    # Pinocchio's root joint takes the role of a floating joint below the world link.
    below = [j for j in text.findall("joint") if _end(j, "parent").get("link") == "world"]
    if [joint.get("type") for joint in below] == ["floating"]:
        for element in (*below, *text.findall("link[@name='world']")):
            text.remove(element)
    for element in text.findall("joint[@type='planar']"):
        _split_planar(text, element, robot)
    bodies, joints = _number_names(text)
    root = [pin.JointModelFreeFlyer()] if robot.floating else []
    try:
        model = pin.buildModelFromXML(ET.tostring(text, encoding="unicode"), *root)
    except (ValueError, RuntimeError) as error:
        raise UnsupportedError(
            f"Pinocchio's parser rejects the URDF: {' '.join(str(error).split())}"
        ) from error
    if model.nv != robot.nv:
        raise UnsupportedError(
            f"Pinocchio's parser finds {model.nv} degrees of freedom, MuJoCo {robot.nv}."
        )
    model.gravity = pin.Motion(robot.tree.gravity, np.zeros(3))
    return _UrdfModel(model, bodies, joints)


def _split_planar(text: ET.Element, joint: ET.Element, robot: RobotModel) -> None:
    """Replace a planar joint by two slides and a hinge along MuJoCo's axes: the URDF gives only the
    normal of the plane."""
    name, end = str(joint.get("name")), _end(joint, "child")
    child, limit = end.get("link"), {"effort": "0", "velocity": "0"}
    for k, (part, kind) in enumerate(PLANAR_PARTS.items()):
        last = k == len(PLANAR_PARTS) - 1
        axis = " ".join(repr(float(x)) for x in robot.mj.joint(name + part).axis)
        if k > 0:
            joint = ET.SubElement(text, "joint")
            ET.SubElement(joint, "parent", link=f"{name}{k - 1} between")
            end = ET.SubElement(joint, "child")
        for old in (*joint.findall("axis"), *joint.findall("limit")):
            joint.remove(old)
        joint.set("name", name + part)
        joint.set("type", kind)
        end.set("link", str(child) if last else f"{name}{k} between")
        ET.SubElement(joint, "axis", xyz=axis)
        ET.SubElement(joint, "limit", limit)
        if not last:
            ET.SubElement(text, "link", name=f"{name}{k} between")


def _number_names(text: ET.Element) -> tuple[dict[str, str], dict[str, str]]:
    """Call links b0, b1, ... and joints j0, j1, ...; return the new names by the old ones."""
    bodies = {str(link.get("name")): f"b{k}" for k, link in enumerate(text.findall("link"))}
    joints = {str(joint.get("name")): f"j{k}" for k, joint in enumerate(text.findall("joint"))}
    for link in text.findall("link"):
        link.set("name", bodies[str(link.get("name"))])
    for joint in text.findall("joint"):
        joint.set("name", joints[str(joint.get("name"))])
        for tag in ("parent", "child"):
            _end(joint, tag).set("link", bodies[str(_end(joint, tag).get("link"))])
    return bodies, joints


def _end(joint: ET.Element, tag: str) -> ET.Element:
    element = joint.find(tag)
    assert element is not None  # the canonical text always has a parent and a child
    return element


def _state(robot: RobotModel, native: _UrdfModel, motion: Trajectory) -> tuple[Array, Array, Array]:
    q = np.tile(pin.neutral(native.model), (len(motion), 1))
    v, a = np.zeros((2, len(motion), native.model.nv))
    v_all, a_all = robot.pairing.rates(motion.q, motion.v, motion.a)
    q_all = robot.pairing.positions_to_pinocchio(motion.q)
    for joint in robot.joints:
        target = native.joint(joint.name, joint.kind)
        qadr, dof, n = target.idx_q, target.idx_v, len(joint.dofs)
        v[:, dof : dof + n] = v_all[:, joint.vadr : joint.vadr + n]
        a[:, dof : dof + n] = a_all[:, joint.vadr : joint.vadr + n]
        if joint.kind in ("hinge", "slide"):
            angle = q_all[:, joint.qadr]
            # Pinocchio represents a continuous joint by cosine and sine.
            parts = [angle] if target.nq == 1 else [np.cos(angle), np.sin(angle)]
            q[:, qadr : qadr + target.nq] = np.stack(parts, axis=1)
        else:
            q[:, qadr : qadr + target.nq] = q_all[:, joint.qadr : joint.qadr + target.nq]
    return q, v, a
