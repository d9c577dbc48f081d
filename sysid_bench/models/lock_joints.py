"""Locked joints: each is removed, and its body is welded to the parent at the given position."""

from collections.abc import Mapping

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.tree import BALL, FREE, HINGE
from sysid_bench.spatial.rotation import (
    matrix_of_quaternion,
    product,
    quaternion_of_vector,
)


def lock_joints(spec: mujoco.MjSpec, mj: mujoco.MjModel, where: Mapping[str, float]) -> None:
    """Remove the named joints from a spec, each at its position (rad, m; ball and free joints at
    their reference); `mj` is the compiled spec. Raises ModelError for an unknown joint, and for one
    that is coupled to a moving joint or shares its body with others.
    """
    known = [mj.joint(j).name for j in range(mj.njnt)]
    for name in where:
        if name not in known:
            raise ModelError(str(unknown_name("joint to be locked", name, known)))
    _drop_couplings(spec, mj, set(where))
    for j, name in enumerate(known):
        if name in where:
            _lock(spec, mj, j, where[name])


def _lock(spec: mujoco.MjSpec, mj: mujoco.MjModel, j: int, position: float) -> None:
    body = next(b for b in spec.bodies if b.id == int(mj.jnt_bodyid[j]))
    joint = next(joint for joint in body.joints if joint.name == mj.joint(j).name)
    kind = int(mj.jnt_type[j])
    moved = position - float(mj.qpos0[mj.jnt_qposadr[j]]) if kind not in (FREE, BALL) else 0.0
    if moved:
        _check_only(mj, j)
        axis, quaternion = np.array(mj.jnt_axis[j]), np.array(mj.body_quat[body.id])
        origin, R = np.array(mj.body_pos[body.id]), matrix_of_quaternion(quaternion)
        if kind == HINGE:
            turn, anchor = quaternion_of_vector(axis * moved), np.array(mj.jnt_pos[j])
            # The anchor stays where it is; the body frame turns about it.
            origin = origin + R @ (anchor - matrix_of_quaternion(turn) @ anchor)
            quaternion = product(quaternion, turn)
        else:
            origin = origin + R @ axis * moved
        body.pos, body.quat = origin, quaternion
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    spec.delete(joint)


def _drop_couplings(spec: mujoco.MjSpec, mj: mujoco.MjModel, locked: set[str]) -> None:
    """Delete the couplings and fixed tendons of locked joints, with the actuators of these tendons:
    forces of tendons are not joint terms.

    Raises ModelError where a locked joint is coupled to a moving one.
    """
    over = {t: _joints_under(mj, t) for t in range(mj.ntendon)}
    tendons = {mj.tendon(t).name for t, joints in over.items() if joints & locked}
    for e in reversed(range(mj.neq)):
        coupled = _coupled(mj, e, over)
        if coupled & locked and coupled - locked and mj.eq_active0[e]:
            raise ModelError(
                f"Joint {min(coupled & locked)!r} cannot be locked while "
                f"{min(coupled - locked)!r}, which is coupled to it, moves: lock both or neither."
            )
        if coupled & locked:
            spec.delete(spec.equalities[e])
    for actuator in [a for a in spec.actuators if a.target in tendons]:
        spec.delete(actuator)
    for tendon in [tendon for tendon in spec.tendons if over[tendon.id] & locked]:
        spec.delete(tendon)


def _joints_under(mj: mujoco.MjModel, t: int) -> set[str]:
    """Names of the joints whose positions a fixed tendon adds up."""
    return {
        mj.joint(int(mj.wrap_objid[w])).name
        for w in range(int(mj.tendon_adr[t]), int(mj.tendon_adr[t] + mj.tendon_num[t]))
        if int(mj.wrap_type[w]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
    }


def _coupled(mj: mujoco.MjModel, e: int, over: Mapping[int, set[str]]) -> set[str]:
    """Names of the joints whose positions an equality relates; none for closed loops."""
    kind, ends = int(mj.eq_type[e]), (int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e]))
    if kind == int(mujoco.mjtEq.mjEQ_JOINT):
        return {mj.joint(end).name for end in ends if end >= 0}
    if kind == int(mujoco.mjtEq.mjEQ_TENDON):
        return set().union(*(over[end] for end in ends if end >= 0))
    return set()


def _check_only(mj: mujoco.MjModel, j: int) -> None:
    """Refuse one of several joints of a body: its pose would depend on the positions of the
    others."""
    if int(mj.body_jntnum[mj.jnt_bodyid[j]]) > 1:
        raise ModelError(
            f"Joint {mj.joint(j).name!r} shares its body with others and can be locked at its "
            f"reference {mj.qpos0[mj.jnt_qposadr[j]]:.4g} alone."
        )
