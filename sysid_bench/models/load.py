"""A manifest and a payload become a RobotModel."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.checks.finite_checks import LARGEST_TREE, check_finite_model
from sysid_bench.models.checks.mujoco_warnings import captured_warnings, warnings_from
from sysid_bench.models.checks.unit_checks import unit_warnings
from sysid_bench.models.coupling.build import Dofs, coupling_of
from sysid_bench.models.coupling.equalities import equalities_of, keep_equalities
from sysid_bench.models.coupling.mimic import add_mimics
from sysid_bench.models.limits import limits_of, stated_limits
from sysid_bench.models.locking import lock_joints
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.mjcf.mjcf_spec import mjcf_spec
from sysid_bench.models.payload import PAYLOADS, Payload
from sysid_bench.models.robot import TYPE_NAMES, Joint, JointTerms, RobotModel
from sysid_bench.models.tree import FREE, tree_of
from sysid_bench.models.urdf.canonical_urdf import (
    MASSLESS,
    TINY_MASS,
    TINY_MOMENT,
    Urdf,
    canonical_urdf,
)
from sysid_bench.models.xml_file import parse_xml, read_bytes
from sysid_bench.spatial.inertia import matrix_of_six, phi_of
from sysid_bench.spatial.rotation import matrix_of_quaternion, quaternion_of_matrix
from sysid_bench.types import Array


def load_robot(
    source: str | Path | Manifest,
    payload: Payload = PAYLOADS["none"],
    free_base: bool | None = None,
    robots_dir: Path | None = None,
) -> RobotModel:
    """The robot of a name, file or manifest, with `payload` at its tool.

    `free_base` overrides the manifest. Raises UsageError for an unknown name, ModelError where the
    file cannot be used, with the reason.
    """
    manifest = source if isinstance(source, Manifest) else find_manifest(str(source), robots_dir)
    free = manifest.free_base if free_base is None else free_base
    warnings_from()
    data = read_bytes(manifest.path) if manifest.text is None else manifest.text.encode()
    root = parse_xml(data, manifest.path.name).tag
    if root == "robot":
        read = _urdf_source(data, manifest, free)
    elif root == "mujoco":
        text = None if manifest.text is None else data
        spec, repairs, actuated = mjcf_spec(manifest.path, text, manifest.assets)
        read = _Source("mjcf", spec, data, repairs, {}, actuated)
    elif root == "mujocoinclude":
        raise ModelError(
            f"{manifest.path.name} is a part to be included in a model; give the file that "
            "includes it."
        )
    else:
        raise ModelError(
            f"{manifest.path.name} is neither URDF nor MJCF: its root element is <{root}>."
        )
    return _assemble(manifest, payload, free, read)


@dataclass(frozen=True, eq=False)
class _Source:
    """A model file as read: what its text says that MuJoCo's spec does not is kept beside it."""

    format: str
    spec: mujoco.MjSpec
    text: bytes
    repairs: tuple[str, ...]
    velocities: dict[str, float]  # limits by joint, rad/s or m/s
    actuated: tuple[str, ...]  # joints with motors


def _assemble(manifest: Manifest, payload: Payload, free: bool, source: _Source) -> RobotModel:
    spec = source.spec
    mended = _free_the_base(spec, manifest) if free else ()
    if manifest.gravity is not None:
        spec.option.gravity = manifest.gravity
    _apply_joint_terms(spec, manifest)
    _name_all(spec, _compile(spec, manifest))
    if manifest.locked:
        lock_joints(spec, _compile(spec, manifest), manifest.locked)
    bare = _compile(spec, manifest)
    names = _body_names(bare)
    tool, pose = _tool(bare, manifest, names)
    if payload:
        _mount(spec, tool + 1, pose, payload, _free_name("payload", names))
    equalities = equalities_of(bare) if manifest.couplings and bare.neq else None
    if equalities is not None:
        keep_equalities(spec, equalities)
    mj = _compile(spec, manifest) if payload or equalities is not None else bare
    joints = _joints(mj)
    _check_rows(manifest, joints)
    _check_known(manifest, joints)
    _check_bodies(manifest, _body_names(mj))
    repairs = (*source.repairs, *mended, *warnings_from(), *unit_warnings(mj))
    coupling = None
    if equalities is not None:
        repairs += equalities.left_out
        if equalities.constraints:
            dofs = _dofs(mj, joints, manifest, source.velocities)
            coupling = coupling_of(
                equalities.constraints, dofs, source.actuated, manifest.independent
            )
            repairs += coupling.repairs
    return RobotModel(
        name=manifest.name,
        manifest=manifest,
        payload=payload,
        mj=mj,
        spec=spec,
        tree=tree_of(mj),
        body_names=_body_names(mj),
        joints=joints,
        phi=_phi(mj),
        joint_terms=_joint_terms(mj, manifest, joints),
        limits=limits_of(mj, joints, manifest, source.velocities),
        tool_body=_index_of(mj, names[tool]) if payload else tool,
        payload_body=_payload_body(mj, bare) if payload else None,
        format=source.format,
        text=source.text,
        repairs=repairs,
        coupling=coupling,
    )


def _dofs(
    mj: mujoco.MjModel,
    joints: tuple[Joint, ...],
    manifest: Manifest,
    velocities: dict[str, float],
) -> Dofs:
    qadr, q0, slides = np.full(mj.nv, -1), np.zeros(mj.nv), np.zeros(mj.nv, dtype=bool)
    for joint in joints:
        if joint.kind in ("hinge", "slide"):
            qadr[joint.vadr], q0[joint.vadr] = joint.qadr, mj.qpos0[joint.qadr]
            slides[joint.vadr] = joint.kind == "slide"
    limits = limits_of(mj, joints, manifest, velocities)
    return Dofs(
        names=tuple(name for joint in joints for name in joint.dofs),
        qadr=qadr,
        q0=q0,
        slides=slides,
        low=limits.q_low,
        high=limits.q_high,
        v=limits.v,
        stated=stated_limits(mj, joints, manifest, velocities),
    )


def _urdf_source(data: bytes, manifest: Manifest, free: bool) -> _Source:
    urdf = canonical_urdf(data, manifest.path.name, free)
    spec = _urdf_spec(urdf, manifest)
    if manifest.couplings:
        told = tuple(add_mimics(spec, urdf.mimic))
    else:
        told = tuple(f"mimic joint {m.joint!r} treated as independent" for m in urdf.mimic)
    repairs = (*told, *urdf.repairs)
    return _Source("urdf", spec, urdf.text.encode(), repairs, urdf.velocity_limits, ())


def _urdf_spec(urdf: Urdf, manifest: Manifest) -> mujoco.MjSpec:
    try:
        return mujoco.MjSpec.from_string(urdf.text)
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"MuJoCo cannot read {manifest.path.name}: {_one_line(error)}") from error


def _compile(spec: mujoco.MjSpec, manifest: Manifest) -> mujoco.MjModel:
    try:
        with captured_warnings():
            mj = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        advice = "; give that body an <inertial>" if "mjMINVAL" in str(error) else ""
        raise ModelError(
            f"MuJoCo cannot compile {manifest.path.name}: {_one_line(error)}{advice}"
        ) from error
    if mj.nv == 0:
        raise ModelError(
            f"{manifest.path.name} has no joint that moves; there is nothing to identify."
        )
    if mj.nv * mj.nbody > LARGEST_TREE:
        raise ModelError(
            f"{manifest.path.name} has {mj.nbody - 1} bodies and {mj.nv} degrees of freedom; "
            f"their product may be {LARGEST_TREE} at most."
        )
    check_finite_model(mj, manifest.path.name)
    return mj


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _free_the_base(spec: mujoco.MjSpec, manifest: Manifest) -> tuple[str, ...]:
    """Gives the root body a free joint, and mass if it has none; what was done, in words."""
    roots = list(spec.worldbody.bodies)
    if len(roots) != 1:
        raise ModelError(
            f"{manifest.name}: a free base needs one root body; there are {len(roots)}."
        )
    if any(int(joint.type) == FREE for joint in roots[0].joints):
        return ()
    if list(roots[0].joints):
        raise ModelError(
            f"{manifest.name}: the root body already has joints; it cannot float as well."
        )
    told = _give_mass_to_root(spec, roots[0])
    joints = tuple(joint.name for joint in spec.joints)
    roots[0].add_freejoint(name=_free_name("root", joints))
    return told


def _give_mass_to_root(spec: mujoco.MjSpec, root: mujoco.MjsBody) -> tuple[str, ...]:
    """A body that moves needs mass, of its own or welded to it; before it floats it needs none."""
    try:
        with captured_warnings():
            mj = spec.compile()
    except (ValueError, mujoco.FatalError):
        return ()  # told where the whole model is compiled
    welded = {root.id}
    for b in range(root.id + 1, mj.nbody):
        if int(mj.body_parentid[b]) in welded and mj.body_jntnum[b] == 0:
            welded.add(b)
    if mj.body_mass[list(welded)].sum() >= MASSLESS:
        return ()
    root.explicitinertial, root.mass, root.inertia = True, TINY_MASS, np.full(3, TINY_MOMENT)
    root.ipos, root.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    root.fullinertia, root.ialt.type = np.full(6, np.nan), mujoco.mjtOrientation.mjORIENTATION_QUAT
    return (f"massless root body {root.name!r} given {TINY_MASS:.0e} kg",)


def _apply_joint_terms(spec: mujoco.MjSpec, manifest: Manifest) -> None:
    everywhere = manifest.joints.get("all")
    for joint in spec.joints:
        if TYPE_NAMES[int(joint.type)] not in ("hinge", "slide"):
            continue
        for terms in (everywhere, manifest.joints.get(joint.name)):
            if terms is None:
                continue
            if terms.viscous is not None:
                joint.damping = _like(joint.damping, terms.viscous)
            if terms.coulomb is not None:
                joint.frictionloss = terms.coulomb
            if terms.armature is not None:
                joint.armature = terms.armature
            if terms.spring is not None:
                joint.stiffness = _like(joint.stiffness, terms.spring)
            if terms.spring_reference is not None:
                joint.springref = terms.spring_reference


def _like(old: Any, value: float) -> Any:
    """MuJoCo 4 keeps polynomials of damping and stiffness; the first number is the linear one."""
    if np.ndim(old) == 0:
        return value
    new = np.zeros_like(np.asarray(old, dtype=float))
    new[0] = value
    return new


def _name_all(spec: mujoco.MjSpec, mj: mujoco.MjModel) -> None:
    """Names what the file leaves unnamed by its place in the bare tree, so that a payload, which
    takes a place of its own, renames nothing: `body3`, `joint2`; the only free joint is `root`."""
    free = [joint for joint in spec.joints if int(joint.type) == FREE]
    taken = {element.name for element in [*spec.bodies, *spec.joints]}
    for body in spec.bodies:
        if not body.name:
            body.name = _free_name(f"body{body.id}", tuple(taken))
    for joint in spec.joints:
        if not joint.name:
            only = len(free) == 1 and int(joint.type) == FREE
            joint.name = _free_name("root" if only else f"joint{joint.id + 1}", tuple(taken))


def _body_names(mj: mujoco.MjModel) -> tuple[str, ...]:
    return tuple(mj.body(b).name for b in range(1, mj.nbody))


def _joints(mj: mujoco.MjModel) -> tuple[Joint, ...]:
    kinds = [int(kind) for kind in mj.jnt_type]
    joints = []
    for j, kind in enumerate(kinds):
        name = mj.joint(j).name
        base = "root" if kind == FREE and kinds.count(FREE) == 1 else name
        dofs = {
            "free": tuple(f"{base}.{d}" for d in ("vx", "vy", "vz", "wx", "wy", "wz")),
            "ball": tuple(f"{name}.{d}" for d in "xyz"),
        }.get(TYPE_NAMES[kind], (name,))
        joints.append(
            Joint(name, TYPE_NAMES[kind], int(mj.jnt_qposadr[j]), int(mj.jnt_dofadr[j]), dofs)
        )
    return tuple(joints)


def _check_rows(manifest: Manifest, joints: tuple[Joint, ...]) -> None:
    owners: dict[str, str] = {}
    for joint in joints:
        for row in joint.dofs:
            if row in owners:
                raise ModelError(
                    f"{manifest.name}: {row!r} would name a degree of freedom of the joint "
                    f"{owners[row]!r} and one of {joint.name!r}; rename one of these joints."
                )
            owners[row] = joint.name


def _check_known(manifest: Manifest, joints: tuple[Joint, ...]) -> None:
    names = {joint.name for joint in joints} | set(manifest.locked)
    for table in (manifest.limits, manifest.joints):
        for name in table:
            if name != "all" and name not in names:
                raise ModelError(f"{manifest.name}: {unknown_name('joint', name, names)}")


def _check_bodies(manifest: Manifest, names: tuple[str, ...]) -> None:
    for body in manifest.massless:
        if body not in names:
            raise ModelError(f"{manifest.name}: massless: {unknown_name('body', body, names)}")


def _phi(mj: mujoco.MjModel) -> Array:
    rows = []
    for b in range(1, mj.nbody):
        R = matrix_of_quaternion(np.array(mj.body_iquat[b]))
        about_com = R @ np.diag(mj.body_inertia[b]) @ R.T
        rows.append(phi_of(float(mj.body_mass[b]), np.array(mj.body_ipos[b]), about_com))
    return np.array(rows)


def _joint_terms(mj: mujoco.MjModel, manifest: Manifest, joints: tuple[Joint, ...]) -> JointTerms:
    viscous = np.array(mj.dof_damping, dtype=float)
    offset, spring, reference = (np.zeros(mj.nv) for _ in range(3))
    coupling = np.zeros((mj.nv, mj.nv))
    scalar = {j.name: j.vadr for j in joints if j.kind in ("hinge", "slide")}
    everywhere = manifest.joints.get("all")
    for j, joint in enumerate(joints):
        if joint.kind not in ("hinge", "slide"):
            continue
        spring[joint.vadr] = float(np.ravel(mj.jnt_stiffness[j])[0])
        reference[joint.vadr] = mj.qpos_spring[joint.qadr]
        for terms in (everywhere, manifest.joints.get(joint.name)):
            if terms is not None and terms.offset is not None:
                offset[joint.vadr] = terms.offset
            for other, value in (terms.viscous_coupling if terms is not None else {}).items():
                coupling[joint.vadr, _other(manifest, joint.name, other, scalar)] = value
    return JointTerms(
        viscous=viscous if viscous.ndim == 1 else viscous[:, 0],
        coulomb=np.array(mj.dof_frictionloss, dtype=float),
        offset=offset,
        armature=np.array(mj.dof_armature, dtype=float),
        spring=spring,
        spring_reference=reference,
        viscous_coupling=coupling,
    )


def _other(manifest: Manifest, joint: str, other: str, scalar: dict[str, int]) -> int:
    if other not in scalar or other == joint:
        known = [name for name in scalar if name != joint]
        raise ModelError(
            f"{manifest.name}: joints.{joint}.viscous_coupling: "
            f"{unknown_name('other hinge or slide', other, known)}"
        )
    return scalar[other]


def _tool(
    mj: mujoco.MjModel, manifest: Manifest, names: tuple[str, ...]
) -> tuple[int, tuple[Array, Array]]:
    """The body that carries payloads (0: the first) and the tool frame (p, quaternion) in it."""
    here = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if manifest.tool is None:
        return _end_of_longest_chain(mj), here
    if manifest.tool in names:
        return names.index(manifest.tool), here
    sites = {mj.site(s).name: s for s in range(mj.nsite)}
    if manifest.tool in sites and mj.site_bodyid[sites[manifest.tool]] > 0:
        site = sites[manifest.tool]
        pose = (np.array(mj.site_pos[site]), np.array(mj.site_quat[site]))
        return int(mj.site_bodyid[site]) - 1, pose
    raise ModelError(
        f"{manifest.name}: {unknown_name('tool body or site', manifest.tool, [*names, *sites])}"
    )


def _end_of_longest_chain(mj: mujoco.MjModel) -> int:
    joints = np.zeros(mj.nbody, dtype=int)
    depth = np.zeros(mj.nbody, dtype=int)
    for b in range(1, mj.nbody):
        p = int(mj.body_parentid[b])
        joints[b] = joints[p] + int(mj.body_jntnum[b])
        depth[b] = depth[p] + 1
    return max(range(1, mj.nbody), key=lambda b: (joints[b], depth[b], -b)) - 1


def _mount(
    spec: mujoco.MjSpec, body: int, pose: tuple[Array, Array], payload: Payload, name: str
) -> None:
    parent = next(b for b in spec.bodies if b.id == body)
    load = parent.add_body(name=name, pos=pose[0], quat=pose[1])
    load.explicitinertial = True
    load.mass = payload.mass
    load.ipos = payload.com
    # Principal moments, since MuJoCo refuses a full inertia with a zero eigenvalue (points, rods).
    moments, axes = np.linalg.eigh(matrix_of_six(np.array(payload.inertia)))
    moments = np.maximum(moments, 0.0)
    moments[2] = min(moments[2], moments[0] + moments[1])  # a lamina lies on the border
    load.inertia = moments
    load.iquat = quaternion_of_matrix(axes * np.sign(np.linalg.det(axes)))


def _free_name(name: str, taken: tuple[str, ...]) -> str:
    while name in taken:
        name += "_"
    return name


def _index_of(mj: mujoco.MjModel, name: str) -> int:
    return _body_names(mj).index(name)


def _payload_body(mj: mujoco.MjModel, bare: mujoco.MjModel) -> int:
    (new,) = set(_body_names(mj)) - set(_body_names(bare))
    return _body_names(mj).index(new)
