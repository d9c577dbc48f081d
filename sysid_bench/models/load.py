"""Loading of a robot: a manifest and a payload become a `RobotModel`.

The order is that of the assembly: read the file (urdf/, mjcf/), free the base, apply the manifest,
lock joints, mount the payload, then couple joints (coupling/).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, StaticModelError, unknown_name
from sysid_bench.models import assembly, joint_terms, model_checks
from sysid_bench.models.coupling import equalities as coupled
from sysid_bench.models.coupling.build import Dofs, coupling_of
from sysid_bench.models.coupling.coordinates import coordinates_of, with_limits, with_rate_limits
from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.manifest import Manifest, find_manifest
from sysid_bench.models.mjcf import mjcf_spec
from sysid_bench.models.mjcf_inertia import principal_inertias
from sysid_bench.models.payload import PAYLOADS, Payload
from sysid_bench.models.robot import TYPE_NAMES, Joint, RobotModel
from sysid_bench.models.tree import tree_of
from sysid_bench.models.urdf import canonical_urdf, gear_ratios
from sysid_bench.models.urdf_links import free_name
from sysid_bench.models.xml_file import parse_xml, read_file
from sysid_bench.spatial import matrix_of_quaternion, phi_of
from sysid_bench.types import Array

SAME: Final = int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY)
ALIGNED: Final = (SAME, int(mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT))
"""Marks of an inertial frame that MuJoCo takes for the body's, as a whole or in its rotation."""


def bodies_phi(mj: mujoco.MjModel) -> Array:
    """Return phi (nb, 10) about each body's frame, of MuJoCo's principal moments about the com."""
    rows = []
    for b in range(1, mj.nbody):
        # MuJoCo takes an inertial frame that is within 1e-6 of the body's for that frame.
        same = int(mj.body_sameframe[b])
        R = np.eye(3) if same in ALIGNED else matrix_of_quaternion(np.array(mj.body_iquat[b]))
        com = np.zeros(3) if same == SAME else np.array(mj.body_ipos[b])
        about_com = R @ np.diag(mj.body_inertia[b]) @ R.T
        rows.append(phi_of(float(mj.body_mass[b]), com, about_com))
    return np.array(rows)


def load_robot(
    source: str | Path | Manifest,
    payload: Payload = PAYLOADS["none"],
    free_base: bool | None = None,
    robots_dir: Path | None = None,
) -> RobotModel:
    """Load the robot of a name, file or manifest, with `payload` at its tool frame.

    `free_base` overrides the manifest. Raises UsageError for an unknown name, and ModelError with
    the reason for a file that cannot be used.
    """
    manifest = source if isinstance(source, Manifest) else find_manifest(str(source), robots_dir)
    free = manifest.free_base if free_base is None else free_base
    model_checks.warnings_from()  # MuJoCo's earlier warnings belong to other models
    return _assemble(manifest, payload, free, _read_source(manifest, free))


@dataclass(frozen=True, eq=False)
class _Source:
    """A model file as read: MuJoCo's spec, and what the text states besides it."""

    format: str
    spec: mujoco.MjSpec
    text: bytes
    repairs: tuple[str, ...]
    velocities: dict[str, float]  # limits by joint, rad/s or m/s
    actuated: tuple[str, ...]  # joints with motors
    motors: Mapping[str, tuple[float, ...]]  # by joint: gear ratio, then its range of force


def _read_source(manifest: Manifest, free: bool) -> _Source:
    """Read a URDF or MJCF, distinguished by the root element, not by the suffix."""
    data = read_file(manifest.path) if manifest.text is None else manifest.text.encode()
    file = manifest.path.name
    element = parse_xml(data, file)
    root = element.tag
    if root == "robot":
        gears = gear_ratios(element)
        urdf = canonical_urdf(data, file, free)
        try:
            spec = mujoco.MjSpec.from_string(urdf.text)
        except (ValueError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())
            raise ModelError(f"MuJoCo cannot read {file}: {reason}") from error
        principal_inertias(spec, urdf.text)
        if manifest.couplings:
            ignored = [*coupled.mimic_equalities(spec, urdf.mimic)]
        else:
            ignored = [f"mimic joint {m.joint!r} treated as independent" for m in urdf.mimic]
        repairs = (*ignored, *urdf.repairs)
        return _Source(
            "urdf", spec, urdf.text.encode(), repairs, urdf.velocity_limits, (), motors=gears
        )
    if root == "mujoco":
        try:
            str(manifest.path).encode()
        except UnicodeEncodeError as error:  # a name of other bytes, which MuJoCo does not take
            name = repr(str(manifest.path))
            raise ModelError(f"MuJoCo needs a path in UTF-8; got {name}: rename it.") from error
        text = None if manifest.text is None else data
        spec, repairs, motors = mjcf_spec(manifest.path, text, manifest.assets)
        return _Source("mjcf", spec, data, repairs, {}, tuple(motors), motors=motors)
    if root == "mujocoinclude":
        raise ModelError(
            f"{file} is a part to be included in a model; give the file that includes it."
        )
    raise ModelError(f"{file} is neither URDF nor MJCF: its root element is <{root}>.")


def _assemble(manifest: Manifest, payload: Payload, free: bool, source: _Source) -> RobotModel:
    spec = source.spec
    base_repairs = assembly.add_free_base(spec, manifest.name) if free else ()
    overridden = tuple(joint_terms.overridden_terms(spec, manifest))
    bare = _bare_model(spec, manifest)
    names = _body_names(bare)
    tool, pose = assembly.tool_frame(bare, manifest, names)
    load = free_name("payload", names)
    if payload:  # MuJoCo counts the world as body 0
        assembly.add_payload(spec, tool + 1, pose, payload, load)
    # Equalities that couple no joints are deleted; the manifest may ignore them all.
    equalities = coupled.equalities_of(bare) if manifest.couplings and bare.neq else None
    if equalities is not None:
        coupled.select_equalities(spec, equalities)
    mj = _compile(spec, manifest) if payload or equalities is not None else bare
    joints, body_names = _joints(mj), _body_names(mj)
    _check_names(manifest, joints, body_names)
    warnings = (*model_checks.warnings_from(), *model_checks.unit_warnings(mj))
    coupling, ignored = _coupling(mj, joints, equalities, manifest, source)
    return RobotModel(
        name=manifest.name,
        manifest=manifest,
        payload=payload,
        mj=mj,
        spec=spec,
        tree=tree_of(mj),
        body_names=body_names,
        joints=joints,
        phi=bodies_phi(mj),
        joint_terms=joint_terms.model_joint_terms(mj, manifest, joints),
        limits=joint_terms.limits_of(mj, joints, manifest, source.velocities),
        # By name: the payload moves the indices of the bodies after it.
        tool_body=body_names.index(names[tool]),
        payload_body=body_names.index(load) if payload else None,
        format=source.format,
        text=source.text,
        repairs=(*source.repairs, *overridden, *base_repairs, *warnings, *ignored),
        coupling=coupling,
        motors=source.motors,
    )


def _bare_model(spec: mujoco.MjSpec, manifest: Manifest) -> mujoco.MjModel:
    """Apply gravity, joint terms, names and locked joints to the spec; compile it unloaded."""
    if manifest.gravity is not None:
        spec.option.gravity = manifest.gravity
    joint_terms.apply_joint_terms(spec, manifest)
    _compile(spec, manifest)  # gives bodies and joints the ids that unnamed ones are called by
    assembly.add_names(spec)
    if manifest.locked:
        assembly.lock_joints(spec, _compile(spec, manifest), manifest.locked)
    return _compile(spec, manifest)


def _coupling(
    mj: mujoco.MjModel,
    joints: tuple[Joint, ...],
    equalities: coupled.Equalities | None,
    manifest: Manifest,
    source: _Source,
) -> tuple[Coupling | None, tuple[str, ...]]:
    """The coupling of a robot, None where all joints are independent, and the equalities and limits
    that are ignored, in words."""
    if equalities is None:
        return None, ()
    if not equalities.constraints:
        return None, equalities.left_out
    # Names, addresses and limits of the degrees of freedom, as coupling needs them.
    qadr, q0 = np.full(mj.nv, -1), np.zeros(mj.nv)
    for joint in joints:
        if joint.kind in ("hinge", "slide"):
            qadr[joint.vadr], q0[joint.vadr] = joint.qadr, mj.qpos0[joint.qadr]
    coordinates = coordinates_of(joints, mj.qpos0, mj.nv)
    limits = joint_terms.limits_of(mj, joints, manifest, source.velocities)
    low, high = with_limits(coordinates, limits.q_low, limits.q_high)
    least, most, v, a = joint_terms.known_limits(mj, joints, manifest, source.velocities)
    dofs = Dofs(
        names=tuple(name for joint in joints for name in joint.dofs),
        qadr=qadr,
        q0=q0,
        coordinates=coordinates,
        low=low,
        high=high,
        v=limits.v,
        stated=(*with_rate_limits(coordinates, least, most), v, a),
    )
    coupling = coupling_of(equalities.constraints, dofs, source.actuated, manifest.independent)
    return coupling, equalities.left_out + coupling.repairs


def _compile(spec: mujoco.MjSpec, manifest: Manifest) -> mujoco.MjModel:
    file = manifest.path.name
    mj, reason = model_checks.compile_spec(spec)
    if mj is None:
        advice = "; give that body an <inertial>" if "mjMINVAL" in reason else ""
        raise ModelError(f"MuJoCo cannot compile {file}: {reason}{advice}")
    if mj.nv == 0:
        raise StaticModelError(f"{file} has no moving joint; there is nothing to identify.")
    if mj.nv * mj.nbody > model_checks.LARGEST_TREE:
        raise ModelError(
            f"{file} has {mj.nbody - 1} bodies and {mj.nv} degrees of freedom; "
            f"their product may be {model_checks.LARGEST_TREE} at most."
        )
    model_checks.check_finite_model(mj, file)
    return mj


def _body_names(mj: mujoco.MjModel) -> tuple[str, ...]:
    return tuple(mj.body(b).name for b in range(1, mj.nbody))


def _joints(mj: mujoco.MjModel) -> tuple[Joint, ...]:
    kinds = [TYPE_NAMES[int(kind)] for kind in mj.jnt_type]
    root = "root" if kinds.count("free") == 1 else None  # the only free joint, whatever its name
    joints = []
    for j, kind in enumerate(kinds):
        name = mj.joint(j).name
        base = (root or name) if kind == "free" else name
        components = {"free": ("vx", "vy", "vz", "wx", "wy", "wz"), "ball": ("x", "y", "z")}
        dofs = tuple(f"{base}.{component}" for component in components.get(kind, ())) or (base,)
        joints.append(Joint(name, kind, int(mj.jnt_qposadr[j]), int(mj.jnt_dofadr[j]), dofs))
    return tuple(joints)


def _check_names(manifest: Manifest, joints: tuple[Joint, ...], bodies: tuple[str, ...]) -> None:
    """Raise ModelError for two degrees of freedom of one name, and for names of the manifest that
    the robot does not have."""
    owners: dict[str, str] = {}
    for row, name in ((row, joint.name) for joint in joints for row in joint.dofs):
        if row in owners:
            raise ModelError(
                f"{manifest.name}: {row!r} would name a degree of freedom of the joint "
                f"{owners[row]!r} and one of {name!r}; rename one of these joints."
            )
        owners[row] = name
    known = {"all", *manifest.locked, *(joint.name for joint in joints)}
    for name in (*manifest.limits, *manifest.joints):
        if name not in known:
            raise ModelError(f"{manifest.name}: {unknown_name('joint', name, known - {'all'})}")
    for body in manifest.massless:
        if body not in bodies:
            raise ModelError(f"{manifest.name}: massless: {unknown_name('body', body, bodies)}")
