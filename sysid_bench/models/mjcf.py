"""An MJCF file as an MjSpec without the parts that need files or play no role in the dynamics."""

from pathlib import Path

import mujoco

from sysid_bench.errors import ModelError

_ASSETS = ("meshes", "hfields", "skins", "textures", "materials")
_UNUSED = ("keys", "pairs", "excludes", "actuators", "sensors")


def mjcf_spec(path: Path) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """The spec and, in words, what had to be left out; raises ModelError with MuJoCo's reason."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(
            f"MuJoCo cannot read {path.name}: {' '.join(str(error).split())}"
        ) from error
    spec.compiler.fusestatic = False  # welded bodies keep their own parameters
    repairs = _drop_mesh_geoms(spec, path)
    for collection in (*_UNUSED, *_ASSETS):
        for element in list(getattr(spec, collection)):
            spec.delete(element)
    for element in [*spec.geoms, *spec.sites, *spec.tendons]:
        element.material = ""
    return spec, repairs


def _drop_mesh_geoms(spec: mujoco.MjSpec, path: Path) -> tuple[str, ...]:
    """Deletes shapes that need files; a body whose inertia came from them is refused by name."""
    files = {
        int(mujoco.mjtGeom.mjGEOM_MESH),
        int(mujoco.mjtGeom.mjGEOM_HFIELD),
        int(mujoco.mjtGeom.mjGEOM_SDF),
    }
    bare = []
    for body in spec.bodies:
        shapes = [geom for geom in body.geoms if int(geom.type) in files or geom.meshname]
        if (
            shapes
            and not body.explicitinertial
            and body.name != "world"
            and len(shapes) == len(list(body.geoms))
        ):
            bare.append(body.name or "(unnamed)")
        for geom in shapes:
            spec.delete(geom)
    if not bare:
        return ()
    return (f"{', '.join(bare)}: inertia came from meshes, which are not read: massless",)
