"""Inertias that MuJoCo's compiler derives from geoms and meshes, made explicit in each body.

Meshes are read only for bodies whose inertia comes from them. Rules for the whole model
(`settotalmass`, `balanceinertia`, bounds) are applied once and then switched off, so that a payload
mounted later is not scaled with the rest.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, first_names
from sysid_bench.input_files import is_file
from sysid_bench.models.joint_terms import linear_polynomial
from sysid_bench.models.mjcf_files import folder_text, is_file_of
from sysid_bench.models.model_checks import recorded_warnings
from sysid_bench.types import Array

_WITH_FILES: Final = (
    int(mujoco.mjtGeom.mjGEOM_MESH),
    int(mujoco.mjtGeom.mjGEOM_HFIELD),
    int(mujoco.mjtGeom.mjGEOM_SDF),
)
_NEVER: Final = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE)
_AUTO: Final = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO)
LARGEST_MESH: Final = 256 * 2**20  # bytes


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
    absent = _Absent.of(lost, folder)
    with_files = [g for g in spec.geoms if int(g.type) in _WITH_FILES or g.meshname]
    _delete_all(spec, [geom for geom in with_files if geom not in kept])
    _keep_meshes(spec, kept)
    if kept or _has_rules(spec) or absent:
        # The compiler's inertias, springs and dampers become numbers of the spec, and its rules are
        # switched off: they would be applied to these numbers once more.
        with _unaligned(spec):
            mj = _compiled(spec, path, absent)
        for body in spec.bodies[1:]:
            _set_inertia(body, mj)
        for joint in spec.joints:
            # `springdamper` (time constant, damping ratio) becomes the stiffness and damping that
            # the compiler computes from it and the inertia of the model.
            if np.any(joint.springdamper):
                dof = mj.jnt_dofadr[joint.id]
                stiffness, damping = mj.jnt_stiffness[joint.id], mj.dof_damping[dof]
                joint.stiffness = linear_polynomial(joint.stiffness, np.ravel(stiffness)[0])
                joint.damping = linear_polynomial(joint.damping, np.ravel(damping)[0])
                joint.springdamper = np.zeros(2)
        rules = spec.compiler
        rules.settotalmass, rules.boundmass, rules.boundinertia = -1.0, 0.0, 0.0
        rules.balanceinertia = False
        rules.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    _delete_all(spec, [*kept, *spec.meshes])
    return (f"{absent}; left out",) if absent else ()


def _delete_all(spec: mujoco.MjSpec, elements: Iterable[Any]) -> None:
    for element in elements:
        spec.delete(element)


@dataclass(frozen=True)
class _Absent:
    """Bodies whose inertia comes from meshes that do not exist."""

    bodies: tuple[str, ...]
    files: tuple[str, ...]
    folder: str

    @classmethod
    def of(cls, lost: Mapping[mujoco.MjsGeom, Path], folder: Path) -> "_Absent":
        """Return them in the order of the text, each once."""
        bodies = dict.fromkeys(geom.parent.name or "(unnamed)" for geom in lost)
        within = folder.resolve()
        names = dict.fromkeys(
            os.path.relpath(os.path.realpath(file), within) for file in lost.values()
        )
        return cls(tuple(bodies), tuple(names), within.name)

    def __bool__(self) -> bool:
        return bool(self.bodies)

    def __str__(self) -> str:
        return (
            f"{first_names(self.bodies)}: inertia came from meshes that do not exist "
            f"({first_names(self.files)}): give each of these bodies an <inertial>, or put "
            f"the meshes into the folder {self.folder!r}"
        )


def _weighing(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> Iterator[mujoco.MjsGeom]:
    """Shapes of a body that need a mesh and contribute to its inertia."""
    mode = int(spec.compiler.inertiafromgeom)
    # "auto" uses shapes where no <inertial> is written, "true" uses them in any case.
    explicit = mode == _NEVER or (mode == _AUTO and body.explicitinertial)
    if not explicit and body.name != "world":
        groups = spec.compiler.inertiagrouprange
        yield from (geom for geom in body.geoms if geom.meshname and _weighs(geom, groups))


def _weighs(geom: mujoco.MjsGeom, groups: Array) -> bool:
    # A mass of NaN means: from the density. Zero of either excludes the shape.
    weight = geom.density if np.isnan(geom.mass) else geom.mass
    return bool(weight != 0 and groups[0] <= geom.group <= groups[1])


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


def _keep_meshes(spec: mujoco.MjSpec, kept: Mapping[mujoco.MjsGeom, Path | None]) -> None:
    """Delete all other meshes and settings that would make the compiler read files."""
    files = {geom.meshname: file for geom, file in kept.items()}
    _delete_all(spec, [mesh for mesh in spec.meshes if mesh.name not in files])
    for mesh in spec.meshes:
        if (file := files[mesh.name]) is not None:
            mesh.file = str(file.resolve())
    # The paths are absolute now and must keep their folders.
    spec.strippath = False


def _has_rules(spec: mujoco.MjSpec) -> bool:
    """True where the compiler changes numbers of the text."""
    rules = spec.compiler
    bounds = (rules.settotalmass, rules.boundmass, rules.boundinertia)
    derived = any(np.any(joint.springdamper) for joint in spec.joints)
    return bool(max(bounds) > 0 or rules.balanceinertia or derived)


@contextmanager
def _unaligned(spec: mujoco.MjSpec) -> Iterator[None]:
    """Keep the frames of the text: alignment would move the frame of a floating body to its
    inertial frame."""
    # Settings of single joints override that of the model.
    aligned = [(joint, joint.align) for joint in spec.joints]
    everywhere = spec.compiler.alignfree
    spec.compiler.alignfree = False
    for joint, _ in aligned:
        joint.align = mujoco.mjtAlignFree.mjALIGNFREE_FALSE
    yield
    for joint, align in aligned:
        joint.align = align
    spec.compiler.alignfree = everywhere


def _compiled(spec: mujoco.MjSpec, path: Path, absent: _Absent) -> mujoco.MjModel:
    try:
        with recorded_warnings():
            return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        if absent:
            raise ModelError(f"{path.name}: {absent}.") from error
        raise ModelError(
            f"MuJoCo cannot compile {path.name}: {' '.join(str(error).split())}"
        ) from error


def _set_inertia(body: mujoco.MjsBody, mj: mujoco.MjModel) -> None:
    if not (mj.body_mass[body.id] > 0 or body.explicitinertial):
        return
    body.explicitinertial = True
    body.mass = float(mj.body_mass[body.id])
    # The compiler has made the moments principal; a full inertia besides would be refused.
    body.ipos, body.iquat = mj.body_ipos[body.id], mj.body_iquat[body.id]
    body.inertia, body.fullinertia = mj.body_inertia[body.id], np.full(6, np.nan)
    # Euler angles and the like in the text would override the quaternion.
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
