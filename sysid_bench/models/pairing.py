"""Pairing of MuJoCo and Pinocchio: one robot in both engines, and the maps between the two.

All differences of convention between the engines are resolved here: Pinocchio has one joint per
joint and lumps welded bodies; its free-flyer velocity is all in the body frame, MuJoCo's linear
part in the world; quaternions are x y z w there and w x y z here. Armature stays outside
`pin.Model`, since a free joint's armature depends on the frame.
"""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
import pinocchio as pin

from sysid_bench.models.tree import BALL, FREE, HINGE, SLIDE, gravity_of
from sysid_bench.spatial import inertia_transform, matrix_of_quaternion
from sysid_bench.types import Array

FROM_PINOCCHIO: Final = (0, 1, 2, 3, 4, 5, 7, 6, 8, 9)
"""Indices in Pinocchio's m h Ixx Ixy Iyy Ixz Iyz Izz of our m h Ixx Ixy Ixz Iyy Iyz Izz."""

_UNDIRECTED: Final = {FREE: pin.JointModelFreeFlyer, BALL: pin.JointModelSpherical}
_ALONG_AXIS: Final = {
    HINGE: pin.JointModelRevoluteUnaligned,
    SLIDE: pin.JointModelPrismaticUnaligned,
}
"""Pinocchio's joints by MuJoCo's types."""


@dataclass(frozen=True, eq=False)
class Pairing:
    """Pinocchio's `model`, and how its joints carry MuJoCo's bodies: body b (not counting the
    world) is fixed to the joint `carrier[b]` (0: the universe), and its parameters act there as
    X[b] @ phi_b."""

    model: pin.Model
    carrier: Array
    X: Array
    poses: tuple[pin.SE3, ...]  # of each body in its carrier
    free: tuple[tuple[int, int], ...]  # (q, v) addresses of free joints
    ball: tuple[tuple[int, int], ...]
    scalar: tuple[tuple[int, float], ...]  # (q address, qpos0) of hinges and slides

    def positions_to_pinocchio(self, q: Array) -> Array:
        """Return Pinocchio's q (..., nq) for MuJoCo's q (..., nq)."""
        out = np.array(q, dtype=float)
        # Pinocchio's joints are at zero where the model is drawn, MuJoCo's at qpos0.
        for address, q0 in self.scalar:
            out[..., address] -= q0
        for start in self._quaternions:
            wxyz = q[..., start : start + 4] / np.linalg.norm(
                q[..., start : start + 4], axis=-1, keepdims=True
            )
            out[..., start : start + 4] = wxyz[..., [1, 2, 3, 0]]
        return out

    @property
    def _quaternions(self) -> list[int]:
        """Addresses in q of the quaternions of free joints (after the position) and ball joints."""
        return [qadr + 3 for qadr, _ in self.free] + [qadr for qadr, _ in self.ball]

    def rates(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return Pinocchio's v and a (N, nv) for MuJoCo's: of a free joint R' v and R' a - w × R' v
        for the linear part, since its axes turn with the body."""
        v, a = np.array(v, dtype=float), np.array(a, dtype=float)
        for qa, va in self.free:
            R_wb = matrix_of_quaternion(q[..., qa + 3 : qa + 7])
            lin, ang = slice(va, va + 3), slice(va + 3, va + 6)
            v[..., lin] = np.einsum("...ji,...j->...i", R_wb, v[..., lin])
            a[..., lin] = np.einsum("...ji,...j->...i", R_wb, a[..., lin]) - np.cross(
                v[..., ang], v[..., lin]
            )
        return v, a

    def rows_to_mujoco(self, q: Array, rows: Array) -> Array:
        """Return torque rows (N, nv, ...) of Pinocchio in MuJoCo's convention: the force of a free
        joint is turned from body to world axes."""
        rows = np.array(rows, dtype=float)
        for qa, va in self.free:
            R_wb = matrix_of_quaternion(q[..., qa + 3 : qa + 7])
            rows[:, va : va + 3] = np.einsum("nij,nj...->ni...", R_wb, rows[:, va : va + 3])
        return rows


def pinocchio_pairing(mj: mujoco.MjModel) -> Pairing:
    """Return the pairing of a compiled MuJoCo model with Pinocchio."""
    model = pin.Model()
    model.gravity = pin.Motion(gravity_of(mj), np.zeros(3))
    carrier = np.zeros(mj.nbody, dtype=int)
    pose = [pin.SE3.Identity()] * mj.nbody  # of each body in its joint
    for b in range(1, mj.nbody):
        p = int(mj.body_parentid[b])
        carrier[b], pose[b] = _add_body(model, mj, b, int(carrier[p]), pose[p])
        R = matrix_of_quaternion(np.array(mj.body_iquat[b]))
        model.appendBodyToJoint(
            int(carrier[b]),
            pin.Inertia(
                float(mj.body_mass[b]),
                np.array(mj.body_ipos[b]),
                R @ np.diag(mj.body_inertia[b]) @ R.T,
            ),
            pose[b],
        )
    X = [inertia_transform(placement.rotation, placement.translation) for placement in pose[1:]]
    scalar = _addresses(mj, HINGE, SLIDE)
    return Pairing(
        model=model,
        carrier=carrier[1:],
        X=np.array(X).reshape(-1, 10, 10),
        poses=tuple(pose[1:]),
        free=_addresses(mj, FREE),
        ball=_addresses(mj, BALL),
        scalar=tuple((qadr, float(mj.qpos0[qadr])) for qadr, _ in scalar),
    )


def _addresses(mj: mujoco.MjModel, *kinds: int) -> tuple[tuple[int, int], ...]:
    """Addresses in q and v of the joints of these kinds."""
    joints = np.flatnonzero(np.isin(mj.jnt_type, kinds))
    return tuple((int(mj.jnt_qposadr[j]), int(mj.jnt_dofadr[j])) for j in joints)


def _add_body(
    model: pin.Model, mj: mujoco.MjModel, b: int, joint: int, parent_pose: pin.SE3
) -> tuple[int, pin.SE3]:
    """Add the joints of body b below `joint`; return the joint that carries b, and b's pose in
    it."""
    placement = parent_pose * pin.SE3(
        matrix_of_quaternion(np.array(mj.body_quat[b])), np.array(mj.body_pos[b])
    )
    for k in range(int(mj.body_jntnum[b])):
        j = int(mj.body_jntadr[b]) + k
        kind = int(mj.jnt_type[j])
        anchor = pin.SE3(np.eye(3), np.zeros(3) if kind == FREE else np.array(mj.jnt_pos[j]))
        if kind == FREE:
            placement = pin.SE3.Identity()  # qpos is absolute
        # Pinocchio turns a joint about the origin of its frame, which is the anchor therefore.
        if kind in _UNDIRECTED:
            along = _UNDIRECTED[kind]()
        else:
            along = _ALONG_AXIS[kind](np.array(mj.jnt_axis[j]) / np.linalg.norm(mj.jnt_axis[j]))
        joint = model.addJoint(joint, along, placement * anchor, f"joint{j}")
        placement = anchor.inverse()
    return joint, placement
