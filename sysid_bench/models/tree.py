"""The kinematic tree of a compiled MuJoCo model as plain constants: no engine is needed afterwards.

A *link* is a body that has joints. Bodies welded to it (or to the world) act through it: their
constant pose is part of `X`. Conventions are MuJoCo's: several joints act in their order on
one body, each about its own anchor `jnt_pos`, with `q - qpos0`; a free joint has linear velocity in
the world and angular velocity in the body.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from types import MappingProxyType
from typing import Final

import mujoco
import numpy as np

from sysid_bench.spatial import inertia_transform, matrix_of_quaternion
from sysid_bench.types import Array

FREE: Final = 0
BALL: Final = 1
SLIDE: Final = 2
HINGE: Final = 3
DOFS: Final = {FREE: 6, BALL: 3, SLIDE: 1, HINGE: 1}
COORDINATES: Final = {FREE: 7, BALL: 4, SLIDE: 1, HINGE: 1}


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """One joint: `kind`, addresses in q and v, axis and anchor (3,) in the body frame, q0."""

    kind: int
    qadr: int
    vadr: int
    axis: Array
    anchor: Array
    q0: float

    @property
    def dofs(self) -> range:
        """Its indices in v."""
        return range(self.vadr, self.vadr + DOFS[self.kind])


@dataclass(frozen=True, eq=False)
class Link:
    """A body with joints; `R0` (3, 3), `p0` (3,): its pose in the parent link (or the world) before
    its own joints move it; `dofs`: every degree of freedom between the world and it."""

    body: int
    parent: int
    R0: Array
    p0: Array
    joints: tuple[TreeJoint, ...]
    dofs: Array


@dataclass(frozen=True, eq=False)
class Tree:
    """Links in tree order; body b is welded to link `carrier[b]` (-1: the world), where its
    parameters act as X[b] @ phi_b, X (nb, 10, 10). `gravity` (3,) in the world."""

    links: tuple[Link, ...]
    carrier: Array
    X: Array
    gravity: Array
    nq: int
    nv: int

    @property
    def joints(self) -> tuple[TreeJoint, ...]:
        """All joints in tree order."""
        return tuple(joint for link in self.links for joint in link.joints)

    def link_parameters(self, phi: Array) -> Array:
        """Return phi (n_links, 10) of each link with all bodies welded to it, from phi (nb, 10)."""
        total = np.zeros((len(self.links), 10))
        for b, link in enumerate(self.carrier):
            if link >= 0:  # bodies welded to the world load no joint
                total[link] += self.X[b] @ phi[b]
        return total


_Pose = tuple[Array, Array]
"""Rotation (3, 3) and position (3,) in another frame."""

_IDENTITY: Final[_Pose] = (np.eye(3), np.zeros(3))

NOTHING: Final[Mapping[int, tuple[TreeJoint, ...]]] = MappingProxyType({})


def tree_of(mj: mujoco.MjModel, more: Mapping[int, tuple[TreeJoint, ...]] = NOTHING) -> Tree:
    """Return the tree of a compiled model; body b here is MuJoCo's body b + 1, after the world.

    `more`: further joints of body b after its own; their addresses in q and v follow the model's.
    """
    links: list[Link] = []
    # Carrier of each body of MuJoCo, and the pose of the body in it.
    carrier: list[int] = [-1]
    poses: list[_Pose] = [_IDENTITY]
    for b in range(1, mj.nbody):
        p = int(mj.body_parentid[b])
        # Reference pose of the body in the carrier of its parent.
        R_p, p_p = poses[p]
        R = R_p @ matrix_of_quaternion(np.array(mj.body_quat[b]))
        pose, parent = (R, p_p + R_p @ np.array(mj.body_pos[b])), carrier[p]
        first = int(mj.body_jntadr[b])
        own_joints = range(first, first + int(mj.body_jntnum[b]))
        joints = (*(_joint(mj, j) for j in own_joints), *more.get(b - 1, ()))
        if joints:
            before = links[parent].dofs.tolist() if parent >= 0 else []
            own = [dof for joint in joints for dof in joint.dofs]
            links.append(Link(b - 1, parent, *pose, joints, np.array([*before, *own], dtype=int)))
            # The body is a link of its own: its frame is that of its parameters.
            parent, pose = len(links) - 1, _IDENTITY
        carrier.append(parent)
        poses.append(pose)
    X = np.array([inertia_transform(R, p) for R, p in poses[1:]]).reshape(-1, 10, 10)
    added = [joint.kind for joint in chain.from_iterable(more.values())]
    nq = mj.nq + sum(COORDINATES[kind] for kind in added)
    nv = mj.nv + sum(DOFS[kind] for kind in added)
    return Tree(tuple(links), np.array(carrier[1:], dtype=int), X, gravity_of(mj), nq, nv)


def gravity_of(mj: mujoco.MjModel) -> Array:
    """Return gravity (3,) in the world, m/s^2; zero where a flag of the model disables it."""
    off = mj.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return np.zeros(3) if off else np.array(mj.opt.gravity)


def _joint(mj: mujoco.MjModel, j: int) -> TreeJoint:
    # int(): `numpy integer == MuJoCo enum` is False even where the values agree.
    kind = int(mj.jnt_type[j])
    qadr = int(mj.jnt_qposadr[j])
    moves_by_scalar = kind in (SLIDE, HINGE)
    return TreeJoint(
        kind=kind,
        qadr=qadr,
        vadr=int(mj.jnt_dofadr[j]),
        axis=np.array(mj.jnt_axis[j]) if moves_by_scalar else np.zeros(3),
        # A free joint acts at the body's origin, whatever its jnt_pos.
        anchor=np.zeros(3) if kind == FREE else np.array(mj.jnt_pos[j]),
        q0=float(mj.qpos0[qadr]) if moves_by_scalar else 0.0,
    )
