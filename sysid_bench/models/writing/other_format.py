"""A robot written in the other format: MJCF from a URDF, URDF from an MJCF.

Bodies, joints, friction, ranges and linear couplings of joints; no shapes and no actuators. What
the format has no place for stands in the manifest beside the file."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, first_names
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import JointTerms, Limits, Manifest
from sysid_bench.models.random_states import random_states
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.urdf_links import MASSLESS
from sysid_bench.models.writing.mjcf_writer import inertia_attributes
from sysid_bench.models.writing.update import FORMATS, Update, torque_of, updated_model
from sysid_bench.models.writing.xml_text import values_text
from sysid_bench.spatial import body_mass_inertia, inertia_values, matrix_of_quaternion
from sysid_bench.types import Array

GAP: Final = 1e-9
"""Largest difference of torques at random states, over the largest torque."""

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
JOINT_EQUALITY: Final = int(mujoco.mjtEq.mjEQ_JOINT)
BETWEEN: Final = 1.01 * MASSLESS * np.array([1, 0, 0, 0, 1e-2, 0, 0, 1e-2, 0, 1e-2])
"""phi (10,) of a link between two joints of a body: one of less mass would count as massless, and
be given more."""

EARTH: Final = (0.0, 0.0, -9.81)
"""Gravity of a URDF, m/s^2."""


def converted(update: Update, manifest: Manifest, form: str, file: str) -> tuple[str, Manifest]:
    """Return the text of a robot with new values as "urdf" or "mjcf", and the manifest that goes
    with it; `manifest`: that of the robot, `file`: the name that the text gets.

    Read again, both together have the inverse dynamics torques of the source. Raises ModelError
    with all that the format cannot hold.
    """
    robot = load_robot(Manifest(update.robot.name, update.robot.manifest.path))
    if missing := list(_not_held(robot, form)):
        raise ModelError(
            f"Not written: {FORMATS['robot' if form == 'urdf' else 'mujoco']} cannot hold "
            f"{'; '.join(missing)}. Write the model in its own format."
        )
    mj = updated_model(update, _phi(update))
    root = _urdf(robot, mj, update) if form == "urdf" else _mjcf(robot, mj, update)
    if form == "urdf":
        _add_tool(root, mj, manifest.tool)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode") + "\n"
    own = _manifest(robot, mj, Manifest(manifest.name, manifest.path), form)
    _check(update, mj, replace(own, path=manifest.path.with_name(file), text=text))
    return text, _manifest(robot, mj, manifest, form)


def _phi(update: Update) -> Array:
    phi = np.array(update.robot.phi)
    for name, values in update.phi.items():
        phi[update.robot.body_names.index(name)] = values
    return phi


def _not_held(robot: RobotModel, form: str) -> Iterator[str]:
    """Yield, in words, what makes torque or motion and has no place in a format."""
    mj = robot.mj
    kinds = mj.eq_type == JOINT_EQUALITY
    curved = kinds & ((mj.eq_data[:, 2:5] != 0).any(axis=1) | (mj.eq_obj2id < 0))
    groups = {
        "equalities that are not joints in a constant ratio": (~kinds).sum() + curved.sum(),
        "tendons with springs, dampers or friction": _acting_tendons(mj),
    }
    yield from (text for text, count in groups.items() if count)
    if form == "urdf":
        balls = [joint.name for joint in robot.joints if joint.kind == "ball"]
        if balls:
            yield f"ball joints ({first_names(balls)})"
        free = [j for j, kind in enumerate(mj.jnt_type) if kind == FREE]
        others = (mj.body_parentid[1:] == 0).sum() > 1
        if len(free) > 1 or (free and others):
            yield "free joints besides that of the only root body"
        dofs = [int(mj.jnt_dofadr[j]) + k for j in free for k in range(6)]
        terms = (mj.dof_armature, mj.dof_frictionloss, mj.dof_damping)
        if any(np.any(values[dofs]) for values in terms):
            yield "friction, damping and rotor inertia of a free joint"


def _acting_tendons(mj: mujoco.MjModel) -> int:
    values = (mj.tendon_stiffness, mj.tendon_damping, mj.tendon_frictionloss, mj.tendon_armature)
    return int(sum(np.any(value) for value in values)) if mj.ntendon else 0


# --- Manifest and check ---------------------------------------------------------------------------


def _manifest(robot: RobotModel, mj: mujoco.MjModel, manifest: Manifest, form: str) -> Manifest:
    """The manifest with what a format does not hold: of a URDF rotors, springs, gravity and a free
    base, of an MJCF limits of rates."""
    joints, limits = dict(manifest.joints), dict(manifest.limits)
    rates = {}
    if robot.format == "urdf":
        found = ET.fromstring(robot.text).iterfind("joint")
        rates = {joint.get("name"): limit for joint in found
                 if (limit := _number(joint.find("limit"), "velocity")) > 0}  # fmt: skip
    for j, joint in enumerate(robot.joints):
        if joint.kind not in ("hinge", "slide"):
            continue
        stiffness = float(np.ravel(mj.jnt_stiffness[j])[0])
        rest = float(mj.qpos_spring[joint.qadr]) if stiffness else 0.0
        armature = float(mj.dof_armature[joint.vadr])
        written = {"armature": armature, "spring": stiffness, "spring_reference": rest}
        terms = {key: value for key, value in written.items() if value}
        if form == "urdf" and terms:
            own = joints.get(joint.name, JointTerms())
            joints[joint.name] = JointTerms(**terms | own.model_dump(exclude_none=True))
        if joint.name in rates:
            stated = limits.get(joint.name, Limits()).model_dump(exclude_none=True)
            limits[joint.name] = Limits(**{"v": rates[joint.name]} | stated)
    gravity = manifest.gravity
    if gravity is None and form == "urdf" and not np.allclose(mj.opt.gravity, EARTH, atol=0):
        gravity = tuple(mj.opt.gravity.tolist())
    floats = manifest.free_base or (form == "urdf" and robot.floating)
    # Fixed joints of a URDF, at which sensors may cut, are bodies of an MJCF.
    children = {}
    if robot.format == "urdf":
        for fixed in ET.fromstring(robot.text).iterfind("joint[@type='fixed']"):
            child = fixed.find("child")
            children[fixed.get("name")] = "" if child is None else child.get("link", "")
    sensors = tuple(
        sensor.model_copy(update={"at": children.get(sensor.at, sensor.at)})
        for sensor in manifest.sensors
    )
    return replace(manifest, joints=joints, limits=limits, gravity=gravity, free_base=floats,
                   sensors=sensors, assets=None, dh=None, paper=None, text=None)  # fmt: skip


def _number(element: ET.Element | None, key: str) -> float:
    return 0.0 if element is None else float(element.get(key, 0.0))


def _check(update: Update, mj: mujoco.MjModel, written: Manifest) -> None:
    """Raise ModelError where the text, read again, has other joints, bodies or torques."""
    source, again = update.robot, load_robot(replace(written, couplings=False))
    if {*again.rows} != {*source.rows} or not {*source.body_names} <= {*again.body_names}:
        raise ModelError(f"{written.path.name} has other bodies or joints than the robot.")
    motion = random_states(source, 10, np.random.default_rng(0))
    rows = [source.rows.index(row) for row in again.rows]
    q = np.zeros((len(motion), again.mj.nq))
    sizes = {"free": 7, "ball": 4}
    at = {joint.name: joint for joint in source.joints}
    free = next((joint for joint in source.joints if joint.kind == "free"), None)
    for joint in again.joints:
        one = at.get(joint.name, free)
        assert one is not None
        size = sizes.get(joint.kind, 1)
        q[:, joint.qadr : joint.qadr + size] = motion.q[:, one.qadr : one.qadr + size]
    moved = replace(motion, q=q, v=motion.v[:, rows], a=motion.a[:, rows])
    theirs, ours = torque_of(again.mj, moved), torque_of(mj, motion)[:, rows]
    gap = float(np.abs(theirs - ours).max()) / (float(np.abs(ours).max()) or 1.0)
    if not gap <= GAP:  # true for NaN, too
        raise ModelError(f"{written.path.name} has other torques than the robot (by {gap:.2g}).")


# --- MJCF -----------------------------------------------------------------------------------------


def _mjcf(robot: RobotModel, mj: mujoco.MjModel, update: Update) -> ET.Element:
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=values_text(*mj.opt.gravity))
    elements = {0: ET.SubElement(root, "worldbody")}
    phi = _phi(update)
    for b in range(1, mj.nbody):
        body = ET.SubElement(
            elements[int(mj.body_parentid[b])], "body", name=mj.body(b).name,
            pos=values_text(*mj.body_pos[b]), quat=values_text(*mj.body_quat[b]),
        )  # fmt: skip
        elements[b] = body
        if phi[b - 1].any():
            mass, com, inertia = body_mass_inertia(phi[b - 1])
            words = {"pos": values_text(*com), "mass": values_text(mass)}
            words |= {key: x for key, x in inertia_attributes(inertia).items() if x is not None}
            ET.SubElement(body, "inertial", words)
        for j in _joints_of(mj, b):
            ET.SubElement(body, "joint", _joint_attributes(robot, mj, j))
    couplings = ET.Element("equality")
    for one, other, ratio, constant in _ratios(robot.mj):
        ET.SubElement(couplings, "joint", joint1=one, joint2=other,
                      polycoef=values_text(constant, ratio, 0, 0, 0))  # fmt: skip
    if len(couplings):
        root.append(couplings)
    return root


def _joint_attributes(robot: RobotModel, mj: mujoco.MjModel, j: int) -> dict[str, str]:
    kind, name = int(mj.jnt_type[j]), mj.joint(j).name
    words = {FREE: "free", BALL: "ball", HINGE: "hinge", SLIDE: "slide"}
    found = {"name": name, "type": words[kind]}
    if kind == FREE:
        return found
    at, q = int(mj.jnt_dofadr[j]), int(mj.jnt_qposadr[j])
    found["pos"] = values_text(*mj.jnt_pos[j])
    if kind in (HINGE, SLIDE):
        found |= {"axis": values_text(*mj.jnt_axis[j]), "ref": values_text(mj.qpos0[q])}
        if mj.jnt_limited[j]:
            found["range"] = values_text(*mj.jnt_range[j])
        if mj.jnt_actfrclimited[j]:
            found["actuatorfrcrange"] = values_text(*mj.jnt_actfrcrange[j])
    values = {
        "damping": float(np.ravel(mj.dof_damping[at])[0]),
        "frictionloss": float(mj.dof_frictionloss[at]),
        "armature": float(mj.dof_armature[at]),
        "stiffness": float(np.ravel(mj.jnt_stiffness[j])[0]),
    }
    if values["stiffness"] and kind in (HINGE, SLIDE):
        values["springref"] = float(mj.qpos_spring[q])
    return found | {key: values_text(value) for key, value in values.items() if value}


def _joints_of(mj: mujoco.MjModel, b: int) -> range:
    first = int(mj.body_jntadr[b])
    return range(first, first + int(mj.body_jntnum[b])) if first >= 0 else range(0)


def _ratios(mj: mujoco.MjModel) -> Iterator[tuple[str, str, float, float]]:
    """Yield the joints coupled as q1 - ref1 = constant + ratio (q2 - ref2)."""
    for e in np.flatnonzero(mj.eq_type == JOINT_EQUALITY):
        constant, ratio = mj.eq_data[e, :2].tolist()
        yield (
            mj.joint(int(mj.eq_obj1id[e])).name,
            mj.joint(int(mj.eq_obj2id[e])).name,
            ratio,
            constant,
        )


# --- URDF -----------------------------------------------------------------------------------------


def _urdf(robot: RobotModel, mj: mujoco.MjModel, update: Update) -> ET.Element:
    """Each body is a link whose frame is that of the body, moved to its last joint; several joints
    of a body have links between them that weigh nothing."""
    root = ET.Element("robot", name=robot.name)
    phi, shift = _phi(update), np.zeros((mj.nbody, 3))  # of the link's origin in the body
    floating = FREE in mj.jnt_type
    if not floating:
        ET.SubElement(root, "link", name="world")
    mimic = {one: (other, ratio, constant) for one, other, ratio, constant in _ratios(robot.mj)}
    for b in range(1, mj.nbody):
        name, p = mj.body(b).name, int(mj.body_parentid[b])
        parent = mj.body(p).name if p else "world"
        pose = _pose(mj.body_pos[b] - shift[p], matrix_of_quaternion(np.array(mj.body_quat[b])))
        joints = [j for j in _joints_of(mj, b) if int(mj.jnt_type[j]) != FREE]
        for k, j in enumerate(joints):
            last = j == joints[-1]
            child = name if last else f"{name}_{k + 1}"
            q0 = float(mj.qpos0[int(mj.jnt_qposadr[j])])
            axis, anchor = np.array(mj.jnt_axis[j]), np.array(mj.jnt_pos[j])
            hinge = int(mj.jnt_type[j]) == HINGE
            # At q = 0 the joint stands -ref from the pose of the file.
            back = (_pose(np.zeros(3), _rotation(axis, -q0)) if hinge
                    else _pose(-q0 * axis, np.eye(3)))  # fmt: skip
            origin = pose @ _pose(anchor, np.eye(3)) @ back
            element = _urdf_joint(root, mj.joint(j).name, parent, child, origin,
                                  "prismatic" if not hinge else _turning(mj, j))  # fmt: skip
            _urdf_details(element, mj, j, mimic, _effort(robot, mj, j))
            if not last:
                _urdf_link(root, child, BETWEEN, np.zeros(3))
            parent, pose = child, _pose(-anchor, np.eye(3))
            shift[b] = anchor
        if not joints and (p or not floating):
            _urdf_joint(root, f"{name}_fixed", parent, name, pose, "fixed")
        _urdf_link(root, name, phi[b - 1], shift[b])
    return root


def _add_tool(root: ET.Element, mj: mujoco.MjModel, tool: str | None) -> None:
    """A massless link in the place of the site that carries payloads."""
    sites = [s for s in range(mj.nsite) if tool is not None and mj.site(s).name == tool]
    for s in sites:
        body = mj.body(int(mj.site_bodyid[s]))
        joints = _joints_of(mj, body.id)
        anchor = mj.jnt_pos[joints[-1]] if joints else np.zeros(3)
        R = matrix_of_quaternion(np.array(mj.site_quat[s]))
        pose = _pose(mj.site_pos[s] - anchor, R)
        _urdf_joint(root, f"{tool}_fixed", body.name, str(tool), pose, "fixed")
        ET.SubElement(root, "link", name=str(tool))


def _urdf_link(root: ET.Element, name: str, phi: Array, shift: Array) -> None:
    link = ET.SubElement(root, "link", name=name)
    if not phi.any():
        return
    mass, com, inertia = body_mass_inertia(phi)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=values_text(*(com - shift)), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=values_text(mass))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = map(values_text, inertia_values(inertia))
    ET.SubElement(inertial, "inertia", dict(zip(names, moments, strict=True)))


def _urdf_joint(
    root: ET.Element, name: str, parent: str, child: str, pose: Array, kind: str
) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=values_text(*pose[:3, 3]), rpy=values_text(*_rpy(pose)))
    return joint


def _turning(mj: mujoco.MjModel, j: int) -> str:
    return "revolute" if mj.jnt_limited[j] else "continuous"


def _effort(robot: RobotModel, mj: mujoco.MjModel, j: int) -> float:
    """Largest torque or force (N m, N) of a joint that the file states; 0 without one."""
    if mj.jnt_actfrclimited[j]:
        return float(np.abs(mj.jnt_actfrcrange[j]).min())
    gear, *force = robot.motors.get(mj.joint(j).name, (0.0, 0.0))
    return abs(gear) * min(map(abs, force), default=0.0)


def _urdf_details(
    joint: ET.Element, mj: mujoco.MjModel, j: int, mimic: Mapping[str, Any], effort: float
) -> None:
    """Axis, range, effort, friction and coupling of a joint."""
    at, name = int(mj.jnt_dofadr[j]), mj.joint(j).name
    ET.SubElement(joint, "axis", xyz=values_text(*mj.jnt_axis[j]))
    # Zero is read as no limit; a URDF requires both.
    limit = {"effort": values_text(effort), "velocity": "0"}
    if mj.jnt_limited[j]:
        limit |= dict(zip(("lower", "upper"), map(values_text, mj.jnt_range[j]), strict=True))
    if mj.jnt_limited[j] or effort or joint.get("type") == "prismatic":
        ET.SubElement(joint, "limit", limit)
    damping, friction = float(np.ravel(mj.dof_damping[at])[0]), float(mj.dof_frictionloss[at])
    if damping or friction:
        ET.SubElement(
            joint, "dynamics", damping=values_text(damping), friction=values_text(friction)
        )
    if name in mimic:
        other, ratio, constant = mimic[name]
        refs = [float(mj.qpos0[int(mj.joint(one).qposadr[0])]) for one in (name, other)]
        ET.SubElement(joint, "mimic", joint=other, multiplier=values_text(ratio),
                      offset=values_text(constant + refs[0] - ratio * refs[1]))  # fmt: skip


def _pose(p: Array, R: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _rotation(axis: Array, angle: float) -> Array:
    half = 0.5 * angle
    return matrix_of_quaternion(np.append(np.cos(half), np.sin(half) * axis))


def _rpy(pose: Array) -> Array:
    """Roll, pitch and yaw of R = Rz Ry Rx. The two others from R Rx', which is accurate at a pitch
    of 90 degrees as well, where roll and yaw are not unique."""
    R = pose[:3, :3]
    roll = np.arctan2(R[2, 1], R[2, 2])
    c, s = np.cos(roll), np.sin(roll)
    rest = R @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    return np.array(
        [roll, np.arctan2(-rest[2, 0], rest[2, 2]), np.arctan2(-rest[0, 1], rest[1, 1])]
    )
