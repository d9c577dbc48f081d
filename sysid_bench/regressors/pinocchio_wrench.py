"""The witness of base wrenches: the sub-tree behind a sensor as a free-flying Pinocchio model whose
root is any of its bodies. Imports no other regressor.

A joint between the sensor and the new root is passed backwards: its placement is inverted, the axis
of a hinge or slide negated, the quaternion of a ball conjugated; positions of hinges and slides and
the signs of their torques stay. The root's pose, twist and acceleration come from Pinocchio's own
forward kinematics of the whole robot.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin

from sysid_bench.models.pairing import FROM_PINOCCHIO
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorCut
from sysid_bench.models.tree import BALL, HINGE
from sysid_bench.spatial.inertia import transport
from sysid_bench.spatial.rotation import matrix_of_quaternion
from sysid_bench.types import Array, Regressor, Trajectory

MOMENT_FIRST: Final = (3, 4, 5, 0, 1, 2)
"""Places in Pinocchio's [f; n] of our [n; f]."""


@dataclass(frozen=True, eq=False)
class _Edge:
    """MuJoCo's joint j from node `near` to node `far`; `before`: where it is placed in `near`."""

    j: int
    parent: int
    child: int
    placement: pin.SE3


@dataclass(frozen=True, eq=False)
class _Graph:
    """The sub-tree without a root: nodes move rigidly, edges are joints. Body b of the cut rides on
    node `node[b]` with the pose `pose[b]` in it."""

    edges: tuple[_Edge, ...]
    node: dict[int, int]
    pose: dict[int, pin.SE3]


@dataclass(frozen=True, eq=False)
class _Rooted:
    """The model with one root: joint and pose in it of every node, and for each edge its Pinocchio
    joint and whether it is passed backwards."""

    model: pin.Model
    joint: dict[int, int]
    pose: dict[int, pin.SE3]
    direction: dict[int, tuple[int, bool]]


def pinocchio_wrench_regressor(
    robot: RobotModel, cut: SensorCut, motion: Trajectory, base: str
) -> tuple[Regressor, Regressor]:
    """(Y_n (N, 6, p) [n; f] at the body `base`, Y_c (N, k, p)) of what is behind a sensor."""
    graph = _graph(robot, cut)
    body = robot.body_names.index(base)
    rooted = _rooted(robot, graph, body)
    q, v, a = _states(robot, graph, rooted, body, motion)
    data = rooted.model.createData()
    Y = np.empty((len(motion), rooted.model.nv, 10 * (rooted.model.njoints - 1)))
    for k in range(len(motion)):
        Y[k] = pin.computeJointTorqueRegressor(rooted.model, data, q[k], v[k], a[k])
    Y = _body_columns(Y, cut, graph, rooted)
    columns = tuple(column for b in cut.bodies for column in robot.bodies[b].columns)
    base_rows = tuple(f"{base}.{row.rpartition('.')[2]}" for row in cut.rows)
    Y_c, names = _joint_rows(robot, graph, rooted, motion, Y)
    return Regressor(Y[:, MOMENT_FIRST], base_rows, columns), Regressor(Y_c, names, columns)


def _graph(robot: RobotModel, cut: SensorCut) -> _Graph:
    node, pose, edges = {cut.body: 0}, {cut.body: pin.SE3.Identity()}, []
    mj, count = robot.mj, 0
    for b in cut.bodies:
        if b == cut.body:
            continue
        parent = int(mj.body_parentid[b + 1]) - 1
        here, place = node[parent], pose[parent] * _fixed(mj.body_pos[b + 1], mj.body_quat[b + 1])
        for k in range(int(mj.body_jntnum[b + 1])):
            j = int(mj.body_jntadr[b + 1]) + k
            anchor = pin.SE3(np.eye(3), np.array(mj.jnt_pos[j]))
            count += 1
            edges.append(_Edge(j, here, count, place * anchor))
            here, place = count, anchor.inverse()
        node[b], pose[b] = here, place
    return _Graph(tuple(edges), node, pose)


def _rooted(robot: RobotModel, graph: _Graph, body: int) -> _Rooted:
    model = pin.Model()
    model.gravity = pin.Motion(np.array(robot.tree.gravity), np.zeros(3))
    first = graph.node[body]
    joint = {first: model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")}
    pose = {first: graph.pose[body].inverse()}
    passed: dict[int, tuple[int, bool]] = {}
    open_nodes = [first]
    while open_nodes:
        here = open_nodes.pop()
        for edge in graph.edges:
            if here not in (edge.parent, edge.child) or edge.j in passed:
                continue
            backwards = here == edge.child
            there = edge.parent if backwards else edge.child
            place = pose[here] if backwards else pose[here] * edge.placement
            joint[there] = model.addJoint(
                joint[here], _joint_model(robot, edge.j, backwards), place, f"joint{edge.j}"
            )
            pose[there] = edge.placement.inverse() if backwards else pin.SE3.Identity()
            passed[edge.j] = joint[there], backwards
            open_nodes.append(there)
    return _Rooted(model, joint, pose, passed)


def _joint_model(robot: RobotModel, j: int, backwards: bool) -> pin.JointModel:
    kind = int(robot.mj.jnt_type[j])
    if kind == BALL:
        return pin.JointModelSpherical()
    axis = np.array(robot.mj.jnt_axis[j]) * (-1 if backwards else 1)
    axis /= np.linalg.norm(axis)
    if kind == HINGE:
        return pin.JointModelRevoluteUnaligned(axis)
    return pin.JointModelPrismaticUnaligned(axis)


def _states(
    robot: RobotModel, graph: _Graph, rooted: _Rooted, body: int, motion: Trajectory
) -> tuple[Array, Array, Array]:
    q = np.tile(pin.neutral(rooted.model), (len(motion), 1))
    v, a = np.zeros((2, len(motion), rooted.model.nv))
    q[:, :7], v[:, :6], a[:, :6] = _base_states(robot, body, motion)
    for edge in graph.edges:
        number, backwards = rooted.direction[edge.j]
        joint = rooted.model.joints[number]
        at, dof = int(robot.mj.jnt_qposadr[edge.j]), int(robot.mj.jnt_dofadr[edge.j])
        own = slice(joint.idx_v, joint.idx_v + joint.nv)
        v[:, own], a[:, own] = (x[:, dof : dof + joint.nv] for x in (motion.v, motion.a))
        if int(robot.mj.jnt_type[edge.j]) != BALL:
            q[:, joint.idx_q] = motion.q[:, at] - robot.mj.qpos0[at]
            continue
        wxyz = motion.q[:, at : at + 4]
        wxyz = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
        q[:, joint.idx_q : joint.idx_q + 4] = wxyz[:, [1, 2, 3, 0]]
        if backwards:
            R = matrix_of_quaternion(wxyz)
            q[:, joint.idx_q : joint.idx_q + 3] *= -1
            v[:, own] = -np.einsum("nij,nj->ni", R, v[:, own])
            a[:, own] = -np.einsum("nij,nj->ni", R, a[:, own])
    return q, v, a


def _base_states(robot: RobotModel, body: int, motion: Trajectory) -> tuple[Array, Array, Array]:
    """Free-flyer q (N, 7), v (N, 6), a (N, 6) of a body, from the paired model of the robot."""
    pairing = robot.pairing
    q = pairing.configuration(motion.q)
    v, a = pairing.rates(motion.q, motion.v, motion.a)
    joint, place = _place_in_joint(robot, body)
    data = pairing.model.createData()
    out = np.empty((len(motion), 7)), np.empty((len(motion), 6)), np.empty((len(motion), 6))
    for k in range(len(motion)):
        pin.forwardKinematics(pairing.model, data, q[k], v[k], a[k])
        out[0][k] = pin.SE3ToXYZQUAT(data.oMi[joint] * place)
        out[1][k] = place.actInv(data.v[joint]).vector
        out[2][k] = place.actInv(data.a[joint]).vector
    return out


def _place_in_joint(robot: RobotModel, body: int) -> tuple[int, pin.SE3]:
    """The joint of the paired model that carries a body, and the body's pose in it."""
    mj, b, place = robot.mj, body + 1, pin.SE3.Identity()
    while b > 0 and mj.body_jntnum[b] == 0:
        place = _fixed(mj.body_pos[b], mj.body_quat[b]) * place
        b = int(mj.body_parentid[b])
    if b > 0:
        last = int(mj.body_jntadr[b] + mj.body_jntnum[b]) - 1
        free = int(mj.jnt_type[last]) == 0
        anchor = np.zeros(3) if free else np.array(mj.jnt_pos[last])
        place = pin.SE3(np.eye(3), -anchor) * place
    return int(robot.pairing.carrier[body]), place


def _fixed(position: Array, quaternion: Array) -> pin.SE3:
    return pin.SE3(matrix_of_quaternion(np.array(quaternion)), np.array(position))


def _body_columns(Y: Array, cut: SensorCut, graph: _Graph, rooted: _Rooted) -> Array:
    per_joint = Y.reshape(*Y.shape[:2], -1, 10)[..., FROM_PINOCCHIO]
    parts = []
    for b in cut.bodies:
        node = graph.node[b]
        place = rooted.pose[node] * graph.pose[b]
        X = transport(place.rotation, place.translation)
        parts.append(per_joint[:, :, rooted.joint[node] - 1] @ X)
    return np.concatenate(parts, axis=-1)


def _joint_rows(
    robot: RobotModel, graph: _Graph, rooted: _Rooted, motion: Trajectory, Y: Array
) -> tuple[Array, tuple[str, ...]]:
    """Rows in MuJoCo's order; a ball that is passed backwards has its moment in the other body."""
    parts = [np.zeros((len(Y), 0, Y.shape[-1]))]
    names: list[str] = []
    for edge in graph.edges:
        number, backwards = rooted.direction[edge.j]
        joint = rooted.model.joints[number]
        rows = Y[:, joint.idx_v : joint.idx_v + joint.nv]
        at, dof = int(robot.mj.jnt_qposadr[edge.j]), int(robot.mj.jnt_dofadr[edge.j])
        if backwards and int(robot.mj.jnt_type[edge.j]) == BALL:
            R = matrix_of_quaternion(motion.q[:, at : at + 4])
            rows = -np.einsum("nji,njp->nip", R, rows)
        parts.append(rows)
        names += robot.rows[dof : dof + joint.nv]
    return np.concatenate(parts, axis=1), tuple(names)
