"""Changes of the MjSpec of a robot: names, free base, locked joints, payload at the tool."""

from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.model_checks import compile_spec
from sysid_bench.models.payload import Payload
from sysid_bench.models.tree import BALL, FREE, HINGE
from sysid_bench.models.urdf_links import MASSLESS, TINY_MASS, TINY_MOMENT, free_name
from sysid_bench.spatial import (
    composed_rotation,
    inertia_matrix,
    matrix_of_quaternion,
    quaternion_of_matrix,
    quaternion_of_rotation,
)
from sysid_bench.types import Array


def add_names(spec: mujoco.MjSpec) -> None:
    """Name unnamed bodies and joints of a compiled spec by their index: `body3`, `joint2`; the only
    free joint is `root`.

    The index is that in the tree without payload, so that mounting a payload renames nothing.
    """
    # The only free joint is the base, whatever the file calls it.
    free = [joint.id for joint in spec.joints if int(joint.type) == FREE]
    only_free = free[0] if len(free) == 1 else None
    taken = {element.name for element in [*spec.bodies, *spec.joints]}
    for body in spec.bodies:
        body.name = body.name or free_name(f"body{body.id}", taken)
    for joint in spec.joints:
        default = "root" if joint.id == only_free else f"joint{joint.id + 1}"
        joint.name = joint.name or free_name(default, taken)


def add_free_base(spec: mujoco.MjSpec, robot: str) -> tuple[str, ...]:
    """Give the root body a free joint, and mass where it has none; return the repairs in words.

    Raises ModelError, with the name of the `robot`, for several root bodies and for a root body
    that has other joints.
    """
    roots = list(spec.worldbody.bodies)
    if len(roots) != 1:
        raise ModelError(f"{robot}: a free base needs one root body; there are {len(roots)}.")
    (root,) = roots
    kinds = {int(joint.type) for joint in root.joints}
    if FREE in kinds:
        return ()
    if kinds:
        raise ModelError(
            f"{robot}: the root body already has joints; a free joint cannot be added to it."
        )
    repairs: tuple[str, ...] = ()
    mj, _ = compile_spec(spec)
    if mj is not None:  # else reported where the whole model is compiled
        # MuJoCo refuses a moving body without mass, of its own or of a body that is welded to it:
        # no joint lies between.
        welded = {root.id}
        for b in range(root.id + 1, mj.nbody):  # parents come before their children
            if int(mj.body_parentid[b]) in welded and mj.body_jntnum[b] == 0:
                welded.add(b)
        if mj.body_mass[list(welded)].sum() < MASSLESS:
            root.explicitinertial, root.mass, root.inertia = (
                True,
                TINY_MASS,
                np.full(3, TINY_MOMENT),
            )
            root.ipos, root.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
            # NaN means "not given"; another orientation in the text would win over iquat.
            root.fullinertia = np.full(6, np.nan)
            root.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
            repairs = (f"massless root body {root.name!r} given {TINY_MASS:.0e} kg",)
    root.add_freejoint(name=free_name("root", [joint.name for joint in spec.joints]))
    return repairs


def lock_joints(spec: mujoco.MjSpec, mj: mujoco.MjModel, where: Mapping[str, float]) -> None:
    """Remove the named joints from a spec, each at its position (rad, m; ball and free joints at
    their reference); `mj` is the compiled spec. Raises ModelError for an unknown joint, and for one
    that is coupled to a moving joint or shares its body with others.
    """
    index = {mj.joint(j).name: j for j in range(mj.njnt)}
    for name in where:
        if name not in index:
            raise ModelError(str(unknown_name("joint to be locked", name, index)))
    _uncouple(spec, mj, set(where))
    for j, name in sorted((index[name], name) for name in where):
        body = next(b for b in spec.bodies if b.id == int(mj.jnt_bodyid[j]))
        joint = next(joint for joint in body.joints if joint.name == name)
        reference, kind = mj.qpos0[mj.jnt_qposadr[j]], int(mj.jnt_type[j])
        displacement = 0.0 if kind in (FREE, BALL) else where[name] - float(reference)
        if displacement:
            # The pose of the body would depend on the positions of its other joints.
            if int(mj.body_jntnum[body.id]) > 1:
                raise ModelError(
                    f"Joint {name!r} shares its body with others and can be locked at its "
                    f"reference {reference:.4g} alone."
                )
            _displace(body, mj, j, displacement)
        spec.delete(joint)


def _displace(body: mujoco.MjsBody, mj: mujoco.MjModel, j: int, displacement: float) -> None:
    """Move a body by its hinge or slide j (rad, m)."""
    origin, quaternion = np.array(mj.body_pos[body.id]), np.array(mj.body_quat[body.id])
    axis, R = np.array(mj.jnt_axis[j]), matrix_of_quaternion(quaternion)
    if int(mj.jnt_type[j]) == HINGE:
        turn, anchor = quaternion_of_rotation(axis * displacement), np.array(mj.jnt_pos[j])
        # The anchor stays where it is; the body frame turns about it.
        body.pos = origin + R @ (anchor - matrix_of_quaternion(turn) @ anchor)
        body.quat = composed_rotation(quaternion, turn)
    else:
        body.pos, body.quat = origin + R @ axis * displacement, quaternion
    # Else euler or axisangle in the text of the model would win over quat.
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _uncouple(spec: mujoco.MjSpec, mj: mujoco.MjModel, locked: set[str]) -> None:
    """Delete couplings and fixed tendons of locked joints, and the actuators of these tendons:
    forces of tendons are not joint terms."""
    spanned = list(_spanned_joints(mj))
    # From the last one: deleting an element moves the indices of those after it.
    for e in reversed(range(mj.neq)):
        joints = _equality_joints(mj, e, spanned)
        if joints & locked:
            if mj.eq_active0[e] and joints - locked:
                raise ModelError(
                    f"Joint {min(joints & locked)!r} cannot be locked while "
                    f"{min(joints - locked)!r}, which is coupled to it, moves: lock both or "
                    "neither."
                )
            spec.delete(spec.equalities[e])
    tendons = [tendon for tendon in spec.tendons if spanned[tendon.id] & locked]
    names = {tendon.name for tendon in tendons}
    # Lists, not iterators: elements are deleted while they are gone through.
    for element in [*(a for a in spec.actuators if a.target in names), *tendons]:
        spec.delete(element)


def _spanned_joints(mj: mujoco.MjModel) -> Iterator[set[str]]:
    """Yield the joints whose positions each tendon adds up."""
    for first, count in zip(mj.tendon_adr, mj.tendon_num, strict=True):
        wraps = range(int(first), int(first + count))
        of_joints = [w for w in wraps if int(mj.wrap_type[w]) == int(mujoco.mjtWrap.mjWRAP_JOINT)]
        yield {mj.joint(int(mj.wrap_objid[w])).name for w in of_joints}


def _equality_joints(mj: mujoco.MjModel, e: int, spanned: Sequence[set[str]]) -> set[str]:
    """The joints that an equality couples, directly or by tendons; none for one of bodies."""
    # An end of -1 means a constant instead of a second joint or tendon.
    ends = [end for end in (int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])) if end >= 0]
    if int(mj.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
        return {mj.joint(end).name for end in ends}
    if int(mj.eq_type[e]) == int(mujoco.mjtEq.mjEQ_TENDON):
        return set().union(*(spanned[end] for end in ends))
    return set()


Pose = tuple[Array, Array]
"""Position (3,) in m and quaternion (4,), w first, in the frame of a body."""


def tool_frame(
    mj: mujoco.MjModel, manifest: Manifest, body_names: tuple[str, ...]
) -> tuple[int, Pose]:
    """Return the index of the body that carries payloads, and the pose of the tool frame in it: the
    manifest's body or site, else the end of the longest chain.

    Raises ModelError for an unknown name.
    """
    at_body = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if manifest.tool is None:
        # The body with the most joints above it; of equals the deepest, of these the first. Ties
        # are frequent: bodies welded to the last link have as many joints above them as it has.
        joints, depth = np.zeros((2, mj.nbody), dtype=int)
        for b in range(1, mj.nbody):
            p = int(mj.body_parentid[b])
            joints[b], depth[b] = joints[p] + int(mj.body_jntnum[b]), depth[p] + 1
        return max(range(1, mj.nbody), key=lambda b: (joints[b], depth[b], -b)) - 1, at_body
    if manifest.tool in body_names:
        return body_names.index(manifest.tool), at_body
    # A site of the world moves with no body.
    sites = {mj.site(s).name: s for s in range(mj.nsite)}
    site = sites.get(str(manifest.tool), -1)
    if site < 0 or mj.site_bodyid[site] == 0:
        known, name = [*body_names, *sites], str(manifest.tool)
        raise ModelError(f"{manifest.name}: {unknown_name('tool body or site', name, known)}")
    pose = (np.array(mj.site_pos[site]), np.array(mj.site_quat[site]))
    return int(mj.site_bodyid[site]) - 1, pose


def add_payload(spec: mujoco.MjSpec, body: int, pose: Pose, payload: Payload, name: str) -> None:
    """Add a body with the inertia of a payload at `pose` in the body with this id of a spec."""
    parent = next(b for b in spec.bodies if b.id == body)
    load = parent.add_body(name=name, pos=pose[0], quat=pose[1])
    load.explicitinertial = True
    load.mass = payload.mass
    load.ipos = payload.com
    # Principal moments, since MuJoCo refuses a full inertia with a zero eigenvalue (points, rods).
    moments, axes = np.linalg.eigh(inertia_matrix(np.array(payload.inertia)))
    moments = np.maximum(moments, 0.0)
    moments[2] = min(moments[2], moments[0] + moments[1])  # a lamina lies on the border
    load.inertia = moments
    load.iquat = quaternion_of_matrix(axes * np.sign(np.linalg.det(axes)))
