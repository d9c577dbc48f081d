"""Reading of an MJCF as an MjSpec, without the parts that need files or do not affect the
dynamics."""

from pathlib import Path

import mujoco

from sysid_bench.errors import ModelError
from sysid_bench.models.mjcf.missing_mass import add_mass
from sysid_bench.models.mjcf.mjcf_files import check_files
from sysid_bench.models.mjcf.mjcf_inertia import compiled_inertia
from sysid_bench.models.mjcf.mjcf_repair import repair_mjcf
from sysid_bench.models.mjcf.mjcf_terms import AT_JOINT, joint_terms_of
from sysid_bench.models.xml_file import read_file

_LOOKS = ("hfields", "skins", "textures", "materials")
_UNUSED = ("keys", "pairs", "excludes", "sensors", "tuples")


def mjcf_spec(
    path: Path, text: bytes | None = None, assets: Path | None = None
) -> tuple[mujoco.MjSpec, tuple[str, ...], tuple[str, ...]]:
    """Return the spec of a file, or of a text without includes that is called `path`; the parts
    left out, in words; and the joints with motors.

    Files are read below the folder `assets` (None: that of `path`). Raises ModelError with MuJoCo's
    reason.
    """
    folder = assets or path.parent
    spec, mended = _read(path, text, folder)
    spec.compiler.fusestatic = False  # welded bodies keep their own parameters
    spec.memory = spec.nstack = spec.njmax = (
        spec.nconmax
    ) = -1  # sizes that the text reserves do not matter
    _delete_unused(spec)
    repairs = mended + compiled_inertia(spec, path, folder)
    repairs += add_mass(spec, path.name)
    repairs += joint_terms_of(spec)
    return spec, repairs, _take_actuators(spec)


def _take_actuators(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Delete the actuators; return the joints that they act on."""
    actuated = tuple(a.target for a in spec.actuators if int(a.trntype) in AT_JOINT)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    return actuated


def _delete_unused(spec: mujoco.MjSpec) -> None:
    """Delete what only a viewer, a contact or a controller uses; textures would need files."""
    for collection in (*_UNUSED, *_LOOKS):
        for element in list(getattr(spec, collection)):
            spec.delete(element)
    for element in [*spec.geoms, *spec.sites, *spec.tendons]:
        element.material = ""


def _read(path: Path, text: bytes | None, folder: Path) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """Spec of a file or text; mended, as the words say, where MuJoCo refuses it as it stands."""
    data = read_file(path) if text is None else text
    check_files(path, data, folder)
    try:
        if text is None:
            return mujoco.MjSpec.from_file(str(path)), ()
        return mujoco.MjSpec.from_string(text.decode()), ()
    except (ValueError, mujoco.FatalError) as error:
        return _read_mended(path, data, error)


def _read_mended(
    path: Path, data: bytes, error: Exception
) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """Mend one fault after the other; raise ModelError for the first that cannot be mended."""
    repairs: tuple[str, ...] = ()
    while True:
        text, more = repair_mjcf(path, data, str(error))
        if not more or set(more) <= set(repairs):
            reason = " ".join(str(error).split())
            raise ModelError(f"MuJoCo cannot read {path.name}: {reason}") from error
        data, repairs = text.encode(), repairs + more
        try:
            return mujoco.MjSpec.from_string(text), repairs
        except (ValueError, mujoco.FatalError) as next_error:
            error = next_error
