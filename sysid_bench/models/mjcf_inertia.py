"""Inertias that MuJoCo's compiler derives from geoms and meshes, made explicit in each body.

Meshes are read only for bodies whose inertia comes from them. Rules for the whole model
(`settotalmass`, `balanceinertia`, bounds) are applied once and then switched off, so that a payload
mounted later is not scaled with the rest.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, first_names
from sysid_bench.input_files import is_file
from sysid_bench.models.joint_terms import linear_polynomial
from sysid_bench.models.mjcf_files import folder_text, is_file_of
from sysid_bench.models.model_checks import BEFORE_3_14, compile_spec
from sysid_bench.models.xml_file import parse_xml
from sysid_bench.spatial import (
    composed_rotation,
    inertia_matrix,
    quaternion_of_matrix,
    urdf_quaternion,
)

_WITH_FILES: Final = (
    int(mujoco.mjtGeom.mjGEOM_MESH),
    int(mujoco.mjtGeom.mjGEOM_HFIELD),
    int(mujoco.mjtGeom.mjGEOM_SDF),
)
_NEVER: Final = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE)
_AUTO: Final = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO)
LARGEST_MESH: Final = 256 * 2**20  # bytes


def principal_inertias(spec: mujoco.MjSpec, urdf: str = "") -> None:
    """Replace full inertias of a spec, read from this URDF or from an MJCF, by principal moments
    and axes where MuJoCo would lose digits."""
    links = parse_xml(urdf, "").findall("link[inertial]") if urdf and BEFORE_3_14 else ()
    origins = {link.get("name"): link.find("inertial/origin[@rpy]") for link in links}
    for body in spec.bodies if BEFORE_3_14 else ():
        full, axes = np.array(body.fullinertia), np.eye(3)
        if not np.isfinite(full).all():  # NaN: none is given
            continue
        moments = full[:3]
        if full[3:].any():
            moments, axes = np.linalg.eigh(inertia_matrix(full[[0, 3, 4, 1, 5, 2]]))
            axes *= np.linalg.det(axes)  # -1 of a reflection
        if moments.min() < mujoco.mjMINVAL:  # for MuJoCo to refuse
            continue
        quat = quaternion_of_matrix(axes)
        if (origin := origins.get(body.name)) is not None:
            rpy = np.array(origin.get("rpy", "").split(), dtype=float)
            quat = composed_rotation(urdf_quaternion(rpy), quat)
        body.inertia, body.iquat, body.fullinertia = moments, quat, np.full(6, np.nan)


def compiled_inertia(spec: mujoco.MjSpec, path: Path, folder: Path) -> tuple[str, ...]:
    """Make the inertias of a spec explicit where meshes or rules of the compiler determine them,
    and delete all shapes that need a file. Return the bodies whose meshes are absent, in words.

    Raises ModelError where such a body moves and has no other mass, or where a mesh lies outside
    `folder`.
    """
    # Shapes with a mesh that contribute to an inertia, and their files.
    weighing = chain.from_iterable(_weighing(spec, body) for body in spec.bodies)
    files = {geom: _mesh_file(spec, geom.meshname, path, folder) for geom in weighing}
    lost = {geom: f for geom, f in files.items() if f is not None and not is_file(f)}
    kept = {geom: file for geom, file in files.items() if geom not in lost}
    absent = _absent_text(lost, folder)
    _delete_shapes_with_files(spec, kept)
    if kept or absent or _has_rules(spec):
        _fix_inertias(spec, path, absent)
    _delete_all(spec, [*kept, *spec.meshes])
    return (f"{absent}; left out",) if absent else ()


def _delete_shapes_with_files(
    spec: mujoco.MjSpec, kept: Mapping[mujoco.MjsGeom, Path | None]
) -> None:
    """Delete the shapes and meshes that would make the compiler read other files than those kept,
    whose paths become absolute."""
    with_files = [g for g in spec.geoms if int(g.type) in _WITH_FILES or g.meshname]
    meshes = {geom.meshname: file for geom, file in kept.items()}
    _delete_all(spec, [geom for geom in with_files if geom not in kept])
    _delete_all(spec, [mesh for mesh in spec.meshes if mesh.name not in meshes])
    for mesh in spec.meshes:
        if (file := meshes[mesh.name]) is not None:
            mesh.file = str(file.resolve())
    spec.strippath = False  # the paths are absolute now and must keep their folders


def _has_rules(spec: mujoco.MjSpec) -> bool:
    """True where the compiler changes inertias, or derives springs and dampers from them."""
    rules = spec.compiler
    changed = max(rules.settotalmass, rules.boundmass, rules.boundinertia) > 0
    derived = any(np.any(joint.springdamper) for joint in spec.joints)
    return bool(changed or rules.balanceinertia or derived)


def _fix_inertias(spec: mujoco.MjSpec, path: Path, absent: str) -> None:
    """Make the compiler's inertias, springs and dampers numbers of the spec, and switch its rules
    off: they would be applied to these numbers once more."""
    rules = spec.compiler
    # Alignment would move the frame of a floating body to its inertial frame; settings of single
    # joints override that of the model.
    aligned, everywhere = [joint.align for joint in spec.joints], rules.alignfree
    rules.alignfree = False
    for joint in spec.joints:
        joint.align = mujoco.mjtAlignFree.mjALIGNFREE_FALSE
    mj, reason = compile_spec(spec)
    if mj is None:
        reason = (
            f"{path.name}: {absent}." if absent else f"MuJoCo cannot compile {path.name}: {reason}"
        )
        raise ModelError(reason)
    rules.alignfree = everywhere
    for joint, align in zip(spec.joints, aligned, strict=True):
        joint.align = align
        # `springdamper` (time constant, damping ratio) becomes the stiffness and damping that the
        # compiler computes from it and the inertia of the model.
        if np.any(joint.springdamper):
            stiffness, damping = mj.jnt_stiffness[joint.id], mj.dof_damping[mj.jnt_dofadr[joint.id]]
            joint.stiffness = linear_polynomial(joint.stiffness, np.ravel(stiffness)[0])
            joint.damping = linear_polynomial(joint.damping, np.ravel(damping)[0])
            joint.springdamper = np.zeros(2)
    for body in spec.bodies[1:]:
        if mj.body_mass[body.id] > 0 or body.explicitinertial:
            body.explicitinertial, body.mass = True, float(mj.body_mass[body.id])
            # The compiler has made the moments principal; a full inertia besides would be refused.
            body.ipos, body.iquat = mj.body_ipos[body.id], mj.body_iquat[body.id]
            body.inertia, body.fullinertia = mj.body_inertia[body.id], np.full(6, np.nan)
            # Euler angles and the like in the text would override the quaternion.
            body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    rules.settotalmass, rules.boundmass, rules.boundinertia = -1.0, 0.0, 0.0
    rules.balanceinertia = False
    rules.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _delete_all(spec: mujoco.MjSpec, elements: Iterable[Any]) -> None:
    for element in elements:
        spec.delete(element)


def _absent_text(lost: Mapping[mujoco.MjsGeom, Path], folder: Path) -> str:
    """Bodies whose inertia comes from meshes that do not exist, in the order of the text; "" if
    there are none."""
    if not lost:
        return ""
    within = folder.resolve()
    files = [os.path.relpath(os.path.realpath(file), within) for file in lost.values()]
    return (
        f"{first_names(geom.parent.name or '(unnamed)' for geom in lost)}: inertia came from "
        f"meshes that do not exist ({first_names(files)}): give each of these bodies an "
        f"<inertial>, or put the meshes into the folder {within.name!r}"
    )


def _weighing(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> Iterator[mujoco.MjsGeom]:
    """Shapes of a body that need a mesh and contribute to its inertia."""
    mode, (first, last) = int(spec.compiler.inertiafromgeom), spec.compiler.inertiagrouprange
    # "auto" uses shapes where no <inertial> is written, "true" uses them in any case.
    explicit = mode == _NEVER or (mode == _AUTO and body.explicitinertial)
    if explicit or body.name == "world":
        return
    for geom in body.geoms:
        # A mass of NaN means: from the density. Zero of either excludes the shape.
        weight = geom.density if np.isnan(geom.mass) else geom.mass
        if geom.meshname and weight != 0 and first <= geom.group <= last:
            yield geom


def _mesh_file(spec: mujoco.MjSpec, name: str, path: Path, folder: Path) -> Path | None:
    """The file of a mesh; None where its vertices are in the text."""
    mesh = spec.mesh(name)
    if mesh is None:
        raise ModelError(f"{path.name}: a geom uses the mesh {name!r}, which is not defined.")
    if not mesh.file:
        return None
    # The compiler drops the folders of the text on demand ("strippath").
    written = Path(mesh.file).name if spec.strippath else str(mesh.file)
    file = path.parent / (spec.compiler.meshdir or "") / written
    if not is_file_of(file, folder):
        raise ModelError(
            f"{path.name}: the inertia of a body comes from the mesh {mesh.file!r}, which lies "
            f"{folder_text(path, file)}; or give the body an <inertial>."
        )
    if is_file(file) and file.stat().st_size > LARGEST_MESH:
        raise ModelError(
            f"{path.name}: the mesh {mesh.file!r} is larger than {LARGEST_MESH} bytes."
        )
    return file
