"""Locked joints: each is removed, and its body is welded to the parent at the given position."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.tree import BALL, FREE, HINGE
from sysid_bench.spatial import (
    composed_rotation,
    matrix_of_quaternion,
    quaternion_of_rotation,
)
from sysid_bench.types import Array


def lock_joints(spec: mujoco.MjSpec, mj: mujoco.MjModel, where: Mapping[str, float]) -> None:
    """Remove the named joints from a spec, each at its position (rad, m; ball and free joints at
    their reference); `mj` is the compiled spec. Raises ModelError for an unknown joint, and for one
    that is coupled to a moving joint or shares its body with others.
    """
    index = {mj.joint(j).name: j for j in range(mj.njnt)}
    for name in where:
        if name not in index:
            raise ModelError(str(unknown_name("joint to be locked", name, index)))
    _drop_couplings(spec, mj, set(where))
    for j, name in sorted((index[name], name) for name in where):
        _lock(spec, mj, j, where[name])


def _lock(spec: mujoco.MjSpec, mj: mujoco.MjModel, j: int, position: float) -> None:
    body = next(b for b in spec.bodies if b.id == int(mj.jnt_bodyid[j]))
    joint = next(joint for joint in body.joints if joint.name == mj.joint(j).name)
    displacement = _displacement(mj, j, position)
    if displacement:
        _check_only(mj, j)
        body.pos, body.quat = _displaced_pose(mj, j, displacement)
        # Else euler or axisangle in the text of the model would win over quat.
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    spec.delete(joint)


def _displacement(mj: mujoco.MjModel, j: int, position: float) -> float:
    """Displacement of a hinge or slide (rad, m) from its reference; 0 for ball and free joints."""
    if int(mj.jnt_type[j]) in (FREE, BALL):
        return 0.0
    return position - float(mj.qpos0[mj.jnt_qposadr[j]])


def _displaced_pose(mj: mujoco.MjModel, j: int, displacement: float) -> tuple[Array, Array]:
    """Position (3,) and quaternion (4,) of a joint's body in its parent, with the joint displaced
    from its reference."""
    b, axis = int(mj.jnt_bodyid[j]), np.array(mj.jnt_axis[j])
    origin, quaternion = np.array(mj.body_pos[b]), np.array(mj.body_quat[b])
    R = matrix_of_quaternion(quaternion)
    if int(mj.jnt_type[j]) != HINGE:
        return origin + R @ axis * displacement, quaternion
    turn, anchor = quaternion_of_rotation(axis * displacement), np.array(mj.jnt_pos[j])
    # The anchor stays where it is; the body frame turns about it.
    origin = origin + R @ (anchor - matrix_of_quaternion(turn) @ anchor)
    return origin, composed_rotation(quaternion, turn)


def _drop_couplings(spec: mujoco.MjSpec, mj: mujoco.MjModel, locked: set[str]) -> None:
    """Delete the couplings and fixed tendons of locked joints, with the actuators of these tendons:
    forces of tendons are not joint terms.

    Raises ModelError where a locked joint is coupled to a moving one.
    """
    spanned = [_tendon_joints(mj, t) for t in range(mj.ntendon)]
    # From the last one: deleting an element moves the indices of those after it.
    for e in reversed(range(mj.neq)):
        joints = _coupled_joints(mj, e, spanned)
        if joints & locked:
            if mj.eq_active0[e]:
                _check_locked_together(joints, locked)
            spec.delete(spec.equalities[e])
    _drop_tendons(spec, {t for t, joints in enumerate(spanned) if joints & locked})


def _drop_tendons(spec: mujoco.MjSpec, ids: set[int]) -> None:
    """Delete tendons by their indices, and before them the actuators that pull them."""
    tendons = [tendon for tendon in spec.tendons if tendon.id in ids]
    names = {tendon.name for tendon in tendons}
    # Lists, not iterators: elements are deleted while they are gone through.
    for actuator in [a for a in spec.actuators if a.target in names]:
        spec.delete(actuator)
    for tendon in tendons:
        spec.delete(tendon)


def _check_locked_together(coupled: set[str], locked: set[str]) -> None:
    """Refuse a coupling between locked and moving joints."""
    if coupled - locked:
        raise ModelError(
            f"Joint {min(coupled & locked)!r} cannot be locked while "
            f"{min(coupled - locked)!r}, which is coupled to it, moves: lock both or neither."
        )


def _tendon_joints(mj: mujoco.MjModel, t: int) -> set[str]:
    """Names of the joints whose positions a fixed tendon adds up."""
    return {
        mj.joint(int(mj.wrap_objid[w])).name
        for w in range(int(mj.tendon_adr[t]), int(mj.tendon_adr[t] + mj.tendon_num[t]))
        if int(mj.wrap_type[w]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
    }


def _coupled_joints(mj: mujoco.MjModel, e: int, spanned: Sequence[set[str]]) -> set[str]:
    """Names of the joints whose positions an equality relates; none for closed loops."""
    # An end of -1 means a constant instead of a second joint or tendon.
    ends = [end for end in (int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])) if end >= 0]
    kind = int(mj.eq_type[e])
    if kind == int(mujoco.mjtEq.mjEQ_JOINT):
        return {mj.joint(end).name for end in ends}
    if kind == int(mujoco.mjtEq.mjEQ_TENDON):
        return set().union(*(spanned[end] for end in ends))
    return set()


def _check_only(mj: mujoco.MjModel, j: int) -> None:
    """Refuse one of several joints of a body: its pose would depend on the positions of the
    others."""
    if int(mj.body_jntnum[mj.jnt_bodyid[j]]) > 1:
        raise ModelError(
            f"Joint {mj.joint(j).name!r} shares its body with others and can be locked at its "
            f"reference {mj.qpos0[mj.jnt_qposadr[j]]:.4g} alone."
        )
