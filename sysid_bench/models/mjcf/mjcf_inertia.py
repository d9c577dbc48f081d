"""Inertias that MuJoCo's compiler derives from geoms and meshes, made explicit in each body.

Meshes are read only for bodies whose inertia comes from them. Rules for the whole model
(`settotalmass`, `balanceinertia`, bounds) are applied once and then switched off, so that a payload
mounted later is not scaled with the rest.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, first_names
from sysid_bench.models.checks.mujoco_warnings import recorded_warnings
from sysid_bench.models.mjcf.mjcf_files import files_outside, is_inside
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
    weighing = [geom for body in spec.bodies for geom in _weighing(spec, body)]
    files = {geom: _mesh_file(spec, geom.meshname, path, folder) for geom in weighing}
    lost = [geom for geom, file in files.items() if file is not None and not file.is_file()]
    absent = _Absent.of(lost, files, folder)
    kept_geoms = [geom for geom in weighing if geom not in lost]
    for geom in [g for g in spec.geoms if _is_filed(g) and g not in kept_geoms]:
        spec.delete(geom)
    _keep_meshes(spec, {geom.meshname: files[geom] for geom in kept_geoms})
    if kept_geoms or _has_rules(spec) or absent:
        _write_down(spec, path, absent)
    for element in [*kept_geoms, *spec.meshes]:
        spec.delete(element)
    return (f"{absent}; left out",) if absent else ()


@dataclass(frozen=True)
class _Absent:
    """Bodies whose inertia comes from meshes that do not exist."""

    bodies: tuple[str, ...]
    files: tuple[str, ...]
    folder: str

    @classmethod
    def of(
        cls, lost: list[mujoco.MjsGeom], files: dict[mujoco.MjsGeom, Path | None], folder: Path
    ) -> "_Absent":
        """Return them in the order of the text, each once."""
        bodies = dict.fromkeys(geom.parent.name or "(unnamed)" for geom in lost)
        found = [file for geom in lost if (file := files[geom]) is not None]
        names = dict.fromkeys(str(file.resolve().relative_to(folder.resolve())) for file in found)
        return cls(tuple(bodies), tuple(names), folder.resolve().name)

    def __bool__(self) -> bool:
        return bool(self.bodies)

    def __str__(self) -> str:
        return (
            f"{first_names(self.bodies)}: inertia came from meshes that do not exist "
            f"({first_names(self.files)}): give each of these bodies an <inertial>, or put "
            f"the meshes into the folder {self.folder!r}"
        )


def _is_filed(geom: mujoco.MjsGeom) -> bool:
    return int(geom.type) in _WITH_FILES or bool(geom.meshname)


def _weighing(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> Iterator[mujoco.MjsGeom]:
    """Shapes of a body that need a mesh and contribute to its inertia."""
    mode = int(spec.compiler.inertiafromgeom)
    if mode == _NEVER or (mode == _AUTO and body.explicitinertial) or body.name == "world":
        return
    low, high = spec.compiler.inertiagrouprange
    for geom in body.geoms:
        weight = geom.density if np.isnan(geom.mass) else geom.mass
        if geom.meshname and weight != 0 and low <= geom.group <= high:
            yield geom


def _mesh_file(spec: mujoco.MjSpec, name: str, path: Path, folder: Path) -> Path | None:
    """The file of a mesh; None where its vertices are in the text."""
    mesh = spec.mesh(name)
    if mesh is None:
        raise ModelError(f"{path.name}: a geom uses the mesh {name!r}, which is not defined.")
    if not mesh.file:
        return None
    written = Path(mesh.file).name if spec.strippath else mesh.file
    file = path.parent / (spec.compiler.meshdir or "") / written
    if not is_inside(file, folder):
        raise ModelError(
            f"{path.name}: the inertia of a body comes from the mesh {mesh.file!r}, which lies "
            f"{files_outside(path, file)}; or give the body an <inertial>."
        )
    if file.is_file() and file.stat().st_size > LARGEST_MESH:
        raise ModelError(
            f"{path.name}: the mesh {mesh.file!r} is larger than {LARGEST_MESH} bytes."
        )
    return file


def _keep_meshes(spec: mujoco.MjSpec, files: Mapping[str, Path | None]) -> None:
    """Delete all other meshes and settings that would make the compiler read files."""
    for mesh in list(spec.meshes):
        if mesh.name not in files:
            spec.delete(mesh)
        elif (file := files[mesh.name]) is not None:
            mesh.file = str(file.resolve())
    spec.strippath = False


def _has_rules(spec: mujoco.MjSpec) -> bool:
    """True where the compiler changes numbers of the text."""
    rules = spec.compiler
    return bool(
        rules.settotalmass > 0
        or rules.boundmass > 0
        or rules.boundinertia > 0
        or rules.balanceinertia
        or any(np.any(joint.springdamper) for joint in spec.joints)
    )


def _write_down(spec: mujoco.MjSpec, path: Path, absent: _Absent) -> None:
    """Compile once and copy the compiler's inertias, springs and dampers into the spec."""
    aligned = [(joint, joint.align) for joint in spec.joints]
    everywhere = spec.compiler.alignfree
    # Alignment would move the frame of a floating body to its inertial frame; the text's is kept.
    spec.compiler.alignfree = False
    for joint, _ in aligned:
        joint.align = mujoco.mjtAlignFree.mjALIGNFREE_FALSE
    mj = _compiled(spec, path, absent)
    for body in spec.bodies:
        if body.id > 0 and (mj.body_mass[body.id] > 0 or body.explicitinertial):
            _set_inertia(body, mj)
    for joint, align in aligned:
        joint.align = align
        if np.any(joint.springdamper):
            joint.stiffness = _like(joint.stiffness, mj.jnt_stiffness[joint.id])
            joint.damping = _like(joint.damping, mj.dof_damping[mj.jnt_dofadr[joint.id]])
            joint.springdamper = np.zeros(2)
    rules = spec.compiler
    rules.alignfree = everywhere
    rules.settotalmass, rules.boundmass, rules.boundinertia = -1.0, 0.0, 0.0
    rules.balanceinertia = False
    rules.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


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
    body.explicitinertial = True
    body.mass = float(mj.body_mass[body.id])
    body.ipos, body.iquat = mj.body_ipos[body.id], mj.body_iquat[body.id]
    body.inertia, body.fullinertia = mj.body_inertia[body.id], np.full(6, np.nan)
    # Euler angles and the like in the text would override the quaternion.
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _like(old: Any, value: Any) -> Array:
    """A polynomial of MuJoCo 4 with its linear coefficient only."""
    new = np.zeros_like(np.asarray(old, dtype=float))
    new[0] = float(np.ravel(value)[0])
    return new
