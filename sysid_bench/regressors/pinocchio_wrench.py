"""Reference regressor of base wrenches: the sub-tree distal to a sensor as a floating Pinocchio
model, rooted at any of its bodies, independently of our kernels.

A joint between the sensor and the new root is traversed in reverse: its placement is inverted, the
axis of a hinge or slide negated, the quaternion of a ball conjugated. Positions of hinges and
slides and the signs of their torques do not change. The root's pose, twist and acceleration come
from Pinocchio's forward kinematics of the whole robot.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin

from sysid_bench.models.pairing import FROM_PINOCCHIO
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.models.tree import BALL, HINGE
from sysid_bench.spatial import inertia_transform, matrix_of_quaternion
from sysid_bench.types import Array, Regressor, Trajectory

MOMENT_FIRST: Final = (3, 4, 5, 0, 1, 2)
"""Indices in Pinocchio's wrench [f; n] of our [n; f]."""


@dataclass(frozen=True, eq=False)
class _Edge:
    """MuJoCo's joint j from node `parent` to node `child`; `placement`: its pose in `parent`."""

    j: int
    parent: int
    child: int
    placement: pin.SE3


@dataclass(frozen=True, eq=False)
class _Graph:
    """Sub-tree as an unrooted graph of rigid nodes and joints (edges): body b of the cut belongs to
    node `node[b]` and has the pose `pose[b]` in it."""

    edges: tuple[_Edge, ...]
    node: dict[int, int]
    pose: dict[int, pin.SE3]


@dataclass(frozen=True, eq=False)
class _Rooted:
    """Pinocchio model with a chosen root: `joint` and `pose` in it of every node; `direction` maps
    MuJoCo's joint to Pinocchio's and whether it is traversed in reverse."""

    model: pin.Model
    joint: dict[int, int]
    pose: dict[int, pin.SE3]
    direction: dict[int, tuple[int, bool]]


def pinocchio_wrench_regressor(
    robot: RobotModel, cut: SensorSubtree, motion: Trajectory, base: str
) -> tuple[Regressor, Regressor]:
    """Return Y_n (N, 6, p), the wrench [n; f] at the body `base` in its axes, and Y_c (N, k, p),
    the torques of the k degrees of freedom, of the sub-tree distal to a sensor."""
    graph = _graph(robot, cut)
    body = robot.body_names.index(base)
    rooted = _rooted(robot, graph, body)
    q, v, a = _states(robot, graph, rooted, body, motion)
    data = rooted.model.createData()
    Y = np.empty((len(motion), rooted.model.nv, 10 * (rooted.model.njoints - 1)))
    for k in range(len(motion)):
        Y[k] = pin.computeJointTorqueRegressor(rooted.model, data, q[k], v[k], a[k])
    per_joint = Y.reshape(*Y.shape[:2], -1, 10)[..., FROM_PINOCCHIO]
    parts = []
    for b in cut.bodies:
        node = graph.node[b]
        pose = rooted.pose[node] * graph.pose[b]
        X = inertia_transform(pose.rotation, pose.translation)
        parts.append(per_joint[:, :, rooted.joint[node] - 1] @ X)
    Y = np.concatenate(parts, axis=-1)
    columns = tuple(column for b in cut.bodies for column in robot.bodies[b].columns)
    base_rows = tuple(f"{base}.{row.rpartition('.')[2]}" for row in cut.rows)
    Y_c, names = _joint_rows(robot, graph, rooted, motion, Y)
    return Regressor(Y[:, MOMENT_FIRST], base_rows, columns), Regressor(Y_c, names, columns)


def _graph(robot: RobotModel, cut: SensorSubtree) -> _Graph:
    node, pose, edges = {cut.body: 0}, {cut.body: pin.SE3.Identity()}, []
    mj, count = robot.mj, 0
    for b in cut.bodies:
        if b == cut.body:
            continue
        parent = int(mj.body_parentid[b + 1]) - 1
        current = node[parent]
        placement = pose[parent] * _fixed(mj.body_pos[b + 1], mj.body_quat[b + 1])
        for k in range(int(mj.body_jntnum[b + 1])):
            j = int(mj.body_jntadr[b + 1]) + k
            anchor = pin.SE3(np.eye(3), np.array(mj.jnt_pos[j]))
            count += 1
            edges.append(_Edge(j, current, count, placement * anchor))
            current, placement = count, anchor.inverse()
        node[b], pose[b] = current, placement
    return _Graph(tuple(edges), node, pose)


def _rooted(robot: RobotModel, graph: _Graph, body: int) -> _Rooted:
    model = pin.Model()
    model.gravity = pin.Motion(np.array(robot.tree.gravity), np.zeros(3))
    first = graph.node[body]
    joint = {first: model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")}
    pose = {first: graph.pose[body].inverse()}
    direction: dict[int, tuple[int, bool]] = {}
    open_nodes = [first]
    while open_nodes:
        near = open_nodes.pop()
        for edge in graph.edges:
            if near not in (edge.parent, edge.child) or edge.j in direction:
                continue
            backwards = near == edge.child
            far = edge.parent if backwards else edge.child
            open_nodes.append(far)
            # In reverse the joint lies at the origin of the child node, whose frame is the joint's.
            placement = pose[near] if backwards else pose[near] * edge.placement
            kind, axis = int(robot.mj.jnt_type[edge.j]), np.array(robot.mj.jnt_axis[edge.j])
            axis = axis * (-1 if backwards else 1) / np.linalg.norm(axis)
            if kind == BALL:
                along = pin.JointModelSpherical()
            elif kind == HINGE:
                along = pin.JointModelRevoluteUnaligned(axis)
            else:
                along = pin.JointModelPrismaticUnaligned(axis)
            joint[far] = model.addJoint(joint[near], along, placement, f"joint{edge.j}")
            pose[far] = edge.placement.inverse() if backwards else pin.SE3.Identity()
            direction[edge.j] = joint[far], backwards
    return _Rooted(model, joint, pose, direction)


def _states(
    robot: RobotModel, graph: _Graph, rooted: _Rooted, body: int, motion: Trajectory
) -> tuple[Array, Array, Array]:
    q = np.tile(pin.neutral(rooted.model), (len(motion), 1))
    v, a = np.zeros((2, len(motion), rooted.model.nv))
    q[:, :7], v[:, :6], a[:, :6] = _base_states(robot, body, motion)
    for edge in graph.edges:
        number, backwards = rooted.direction[edge.j]
        joint = rooted.model.joints[number]
        qadr, dof = int(robot.mj.jnt_qposadr[edge.j]), int(robot.mj.jnt_dofadr[edge.j])
        dofs = slice(joint.idx_v, joint.idx_v + joint.nv)
        v[:, dofs], a[:, dofs] = (x[:, dof : dof + joint.nv] for x in (motion.v, motion.a))
        if int(robot.mj.jnt_type[edge.j]) != BALL:
            q[:, joint.idx_q] = motion.q[:, qadr] - robot.mj.qpos0[qadr]
            continue
        wxyz = motion.q[:, qadr : qadr + 4]
        wxyz = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
        q[:, joint.idx_q : joint.idx_q + 4] = wxyz[:, [1, 2, 3, 0]]
        if backwards:
            R = matrix_of_quaternion(wxyz)
            q[:, joint.idx_q : joint.idx_q + 3] *= -1
            v[:, dofs] = -np.einsum("nij,nj->ni", R, v[:, dofs])
            a[:, dofs] = -np.einsum("nij,nj->ni", R, a[:, dofs])
    return q, v, a


def _base_states(robot: RobotModel, body: int, motion: Trajectory) -> tuple[Array, Array, Array]:
    """Free-flyer q (N, 7), v (N, 6) and a (N, 6) of a body, from the paired model of the robot;
    velocities [v; w] are in body axes."""
    pairing = robot.pairing
    q = pairing.positions_to_pinocchio(motion.q)
    v, a = pairing.rates(motion.q, motion.v, motion.a)
    # Joint of the paired model that carries a body, and the body's pose in it.
    mj, b, pose = robot.mj, body + 1, pin.SE3.Identity()
    while b > 0 and mj.body_jntnum[b] == 0:
        pose = _fixed(mj.body_pos[b], mj.body_quat[b]) * pose
        b = int(mj.body_parentid[b])
    if b > 0:
        last = int(mj.body_jntadr[b] + mj.body_jntnum[b]) - 1
        free = int(mj.jnt_type[last]) == 0
        anchor = np.zeros(3) if free else np.array(mj.jnt_pos[last])
        pose = pin.SE3(np.eye(3), -anchor) * pose
    joint, placement = int(robot.pairing.carrier[body]), pose
    data = pairing.model.createData()
    out = np.empty((len(motion), 7)), np.empty((len(motion), 6)), np.empty((len(motion), 6))
    for k in range(len(motion)):
        pin.forwardKinematics(pairing.model, data, q[k], v[k], a[k])
        out[0][k] = pin.SE3ToXYZQUAT(data.oMi[joint] * placement)
        out[1][k] = placement.actInv(data.v[joint]).vector
        out[2][k] = placement.actInv(data.a[joint]).vector
    return out


def _fixed(position: Array, quaternion: Array) -> pin.SE3:
    return pin.SE3(matrix_of_quaternion(np.array(quaternion)), np.array(position))


def _joint_rows(
    robot: RobotModel, graph: _Graph, rooted: _Rooted, motion: Trajectory, Y: Array
) -> tuple[Array, tuple[str, ...]]:
    """Rows in MuJoCo's order. The moment of a ball that is traversed in reverse is in the axes of
    the other body, and has to be rotated."""
    parts = [np.zeros((len(Y), 0, Y.shape[-1]))]
    names: list[str] = []
    for edge in graph.edges:
        number, backwards = rooted.direction[edge.j]
        joint = rooted.model.joints[number]
        rows = Y[:, joint.idx_v : joint.idx_v + joint.nv]
        qadr, dof = int(robot.mj.jnt_qposadr[edge.j]), int(robot.mj.jnt_dofadr[edge.j])
        if backwards and int(robot.mj.jnt_type[edge.j]) == BALL:
            R = matrix_of_quaternion(motion.q[:, qadr : qadr + 4])
            rows = -np.einsum("nji,njp->nip", R, rows)
        parts.append(rows)
        names += robot.rows[dof : dof + joint.nv]
    return np.concatenate(parts, axis=1), tuple(names)
