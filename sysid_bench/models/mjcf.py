"""Reading of an MJCF: files checked, faults repaired, masses and terms as in both engines."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.input_files import is_file
from sysid_bench.models.joint_terms import linear_polynomial
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.mjcf_files import check_files
from sysid_bench.models.mjcf_inertia import compiled_inertia, principal_inertias
from sysid_bench.models.model_checks import compile_spec
from sysid_bench.models.urdf_links import MASSLESS, TINY_MASS, TINY_MOMENT, point_inertia
from sysid_bench.models.xml_file import parse_xml, read_file

_UNKNOWN: Final = re.compile(r"unrecognized attribute: '([^']+)'\s*Element '([^']+)'")
_SETTINGS: Final = ("option", "flag", "default", "size", "map", "global", "quality", "statistic")
"""Elements whose unknown attributes concern the solver, the viewer or memory."""
_ASSETS: Final = ("mesh", "texture", "material")
_PARTS: Final = ("geom", "site", "camera", "light")
"""Elements of bodies that are not needed by name, since a reference reaches the first one."""
_WITH_FILES: Final = ("model", "flexcomp")
"""Elements with files that are read from the folder of the text, which a changed text has not."""


def repair_mjcf(path: Path, text: bytes, error: str) -> tuple[str, tuple[str, ...]]:
    """Return a text, included files in it, without what MuJoCo's `error` complains of, and the
    changes in words; none where it cannot be repaired."""
    root = element_tree(path, text)
    if any(next(root.iter(tag), None) is not None for tag in _WITH_FILES):
        return "", ()
    repairs: list[str] = []
    unknown = _UNKNOWN.search(error)
    if unknown is not None and unknown[2] in _SETTINGS:
        for element in root.iter(unknown[2]):
            element.attrib.pop(unknown[1], None)
        repairs.append(f"unknown attribute {unknown[1]!r} of <{unknown[2]}> left out")
    if "repeated name" in error:
        known: set[tuple[str, str]] = set()
        for section in root.findall("asset"):
            for asset in _repeated(section, _ASSETS, known):
                section.remove(asset)
                repairs.append(f"repeated {asset.tag} {asset.get('name')!r}: the first is used")
        for part in _repeated(root.findall("worldbody//*"), _PARTS, known):
            name = part.attrib.pop("name")
            repairs.append(f"repeated name of {part.tag} {name!r}: the first keeps it")
    if "attribute missing: 'pos'" in error and "'inertial'" in error:
        repairs += _place_inertials(root)
    return ET.tostring(root, encoding="unicode"), tuple(repairs)


def _place_inertials(root: ET.Element) -> Iterator[str]:
    for body in root.iter("body"):
        for inertial in body.findall("inertial"):
            if "pos" not in inertial.attrib:
                inertial.set("pos", "0 0 0")
                name = body.get("name", "")
                yield f"<inertial> of body {name!r} without position: at its origin"


def _repeated(
    parts: Iterable[ET.Element], tags: tuple[str, ...], known: set[tuple[str, str]]
) -> list[ET.Element]:
    """The elements of these kinds whose name is `known`; the names of the others are added."""
    found = []
    for part in parts:
        if part.tag in tags and (name := part.get("name")):
            if (part.tag, name) in known:
                found.append(part)
            known.add((part.tag, name))
    return found


def element_tree(path: Path, text: bytes) -> ET.Element:
    """Return the root of a model with the elements of all files that it includes, which MuJoCo
    looks for in the folders of the model and of the including file."""
    root = parse_xml(text, path.name)
    _include(root, path, path.parent)
    return root


def _include(element: ET.Element, path: Path, folder: Path) -> None:
    """Replace the <include> elements below `element`, which is of the file `path`."""
    for child in [part for part in element if part.tag == "include"]:
        files = [place / child.get("file", "") for place in (folder, path.parent)]
        file = next(filter(is_file, files), files[0])
        inner = parse_xml(read_file(file), file.name)
        _include(inner, file, folder)
        place = list(element).index(child)
        element.remove(child)
        for k, part in enumerate(inner):
            element.insert(place + k, part)
    for child in element:
        _include(child, path, folder)


_LIGHT: Final = re.compile(r"mjMINVAL.*?\bid (\d+)", re.DOTALL)
"""MuJoCo's error for such a body, with its number."""


def add_mass(spec: mujoco.MjSpec, name: str) -> tuple[str, ...]:
    """Give the bodies that MuJoCo refuses as too light a small mass and inertia, in place; return
    this in words.

    Raises ModelError, with the file's `name`, where no body that moves has a mass: the file
    describes no dynamics.
    """
    repairs: dict[int, str] = {}
    # Before the first compilation: after one that has failed a spec does not list its shapes.
    kept = {0, *(b for b, body in enumerate(spec.bodies) if not _may_be_completed(body))}
    while True:
        # The compiler names one body at a time; other errors are reported by who compiles next.
        mj, reason = compile_spec(spec)
        found = _LIGHT.search(reason)
        b = int(found[1]) if found else 0
        if b in kept or b in repairs:
            break
        repairs[b] = _complete_body(spec.bodies[b])
    if repairs and mj is not None and all(spec.bodies[b].mass == TINY_MASS for b in repairs):
        masses = np.where(mj.body_weldid > 0, mj.body_mass, 0.0)
        if np.delete(masses, [*repairs]).max(initial=0.0) <= MASSLESS:
            raise ModelError(
                f"{name} is not a model of dynamics: no body that moves has a mass; use a file "
                "with <inertial> elements, or with shapes that have a density."
            )
    return tuple(repairs.values())


def _complete_body(body: mujoco.MjsBody) -> str:
    """Give a point mass an inertia, a massless body both, in place; return this in words."""
    mass = float(body.mass) if body.explicitinertial else 0.0
    label = f"{body.name!r}" if body.name else "(unnamed)"
    if mass >= MASSLESS:
        moment = point_inertia(mass)
        repair = f"point mass of body {label} given the inertia {moment:.2g} kg m^2"
    else:
        mass, moment, body.ipos = TINY_MASS, TINY_MOMENT, np.zeros(3)
        repair = f"massless moving body {label} given {TINY_MASS:.0e} kg"
    body.explicitinertial, body.mass = True, mass
    body.inertia, body.fullinertia = np.full(3, moment), np.full(6, np.nan)
    return repair


def _may_be_completed(body: mujoco.MjsBody) -> bool:
    """True for a body of no mass, and for a point mass; numbers that cannot be stay as they are,
    for MuJoCo to refuse."""
    if not body.explicitinertial:
        return not any(geom.mass < 0 or geom.density < 0 for geom in body.geoms)
    moments = np.concatenate([body.inertia, body.fullinertia[~np.isnan(body.fullinertia)]])
    has_moments = bool(moments.min() < 0) or (body.mass >= MASSLESS and bool(moments.any()))
    return bool(body.mass >= 0) and not has_moments


_SCALAR: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
AT_JOINT: Final = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_DISABLING: Final = {
    "stiffness": int(mujoco.mjtDisableBit.mjDSBL_SPRING),
    "damping": int(mujoco.mjtDisableBit.mjDSBL_DAMPER),
    "frictionloss": int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS),
}
"""Joint terms, and the flag of MuJoCo that switches each off."""


def joint_terms_of(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Gather the joint terms of a spec at its joints; return what is left out, in words."""
    left_out = [*_reflect_actuators(spec)]
    for joint in spec.joints:
        for key, word in (("stiffness", "spring"), ("damping", "damper")):
            numbers = np.asarray(getattr(joint, key), dtype=float)
            if numbers[1:].any():
                setattr(joint, key, linear_polynomial(numbers, numbers[0]))
                left_out.append(f"non-linear part of the {word} of joint {_label(joint)} left out")
    # The flags would also switch off terms that are identified and written later: they become
    # zeros of the joints, as the model means them.
    flags = int(spec.option.disableflags)
    for key, bit in _DISABLING.items():
        for joint in spec.joints if flags & bit else ():
            _zero_terms(joint, (key,))
        spec.option.disableflags &= ~bit
    return (*left_out, *_drop_forces(spec))


def _reflect_actuators(spec: mujoco.MjSpec) -> Iterator[str]:
    """Move armature and damping of actuators to the joints they act on."""
    joints = {joint.name: joint for joint in spec.joints}
    for actuator in spec.actuators:
        damping = np.atleast_1d(np.asarray(actuator.damping, dtype=float))
        if not (actuator.armature or damping.any()):
            continue
        joint = joints.get(actuator.target)
        if joint is None or not (int(actuator.trntype) in AT_JOINT and int(joint.type) in _SCALAR):
            name = _label(actuator)
            yield f"armature and damping of actuator {name} left out: it acts on no hinge or slide"
            continue
        if damping[1:].any():
            yield f"non-linear damping of actuator {_label(actuator)} left out"
        # The motor turns `gear` times as fast and its torque counts `gear` times: hence the square.
        square = float(actuator.gear[0]) ** 2
        joint.armature += square * actuator.armature
        joint.damping = np.asarray(joint.damping) + linear_polynomial(
            joint.damping, square * damping[0]
        )


def _drop_forces(spec: mujoco.MjSpec) -> Iterator[str]:
    """Drop the forces that are neither in M(q) a + h(q, v) nor a term of one hinge or slide."""
    for joint in spec.joints:
        # Its torque depends on a rotation vector, not on one coordinate as the other springs do.
        if int(joint.type) not in _SCALAR and _zero_terms(joint, ("stiffness",)):
            yield f"spring of joint {_label(joint)} left out: it is neither hinge nor slide"

    for tendon in spec.tendons:
        if found := _zero_terms(tendon, ("stiffness", "damping", "frictionloss", "armature")):
            terms = ", ".join(found)
            yield f"{terms} of tendon {_label(tendon)} left out: not a term of one joint"
    # Drag depends on the shapes of bodies, which are not a part of the regressor.
    if spec.option.density or spec.option.viscosity:
        spec.option.density = spec.option.viscosity = 0.0
        yield "forces of the medium (density, viscosity) left out"
    # Gravity compensation is a force at the body.
    lifted = [body for body in spec.bodies if _zero_terms(body, ("gravcomp",))]
    if lifted:
        yield f"gravity compensation of {', '.join(map(_label, lifted))} left out"


def _zero_terms(element: Any, keys: Sequence[str]) -> list[str]:
    """Set terms of an element to zero; return those that were not."""
    found = [key for key in keys if np.any(getattr(element, key))]
    for key in found:
        value = getattr(element, key)
        setattr(element, key, 0.0 if np.ndim(value) == 0 else np.zeros_like(value))
    return found


def _label(element: Any) -> str:
    return repr(element.name) if element.name else "(unnamed)"


_UNUSED: Final = (
    *("hfields", "skins", "textures", "materials"),
    *("keys", "pairs", "excludes", "sensors", "tuples"),
)
"""Elements that only a viewer, a contact or a controller uses; textures would need files."""


def mjcf_spec(
    path: Path, text: bytes | None = None, assets: Path | None = None
) -> tuple[mujoco.MjSpec, tuple[str, ...], dict[str, tuple[float, ...]]]:
    """Return the spec of a file, or of a text without includes that is called `path`; the parts
    left out, in words; and the joints with motors, each with gear ratio and range of force.

    Files are read below the folder `assets` (None: that of `path`). Raises ModelError with MuJoCo's
    reason.
    """
    folder = assets or path.parent
    spec, repairs = _read(path, text, folder)
    spec.compiler.fusestatic = False  # welded bodies keep their own parameters
    for size in ("memory", "nstack", "njmax", "nconmax"):
        setattr(spec, size, -1)  # sizes that the text reserves do not matter
    for collection in _UNUSED:
        for element in list(getattr(spec, collection)):
            spec.delete(element)
    for element in [*spec.geoms, *spec.sites, *spec.tendons]:
        element.material = ""
    principal_inertias(spec)
    repairs += compiled_inertia(spec, path, folder)
    repairs += add_mass(spec, path.name)
    repairs += joint_terms_of(spec)
    # Torques are inputs here; of the actuators only joints, gears and ranges of force are kept.
    motors = {
        a.target: (float(a.gear[0]), *map(float, a.forcerange))
        for a in spec.actuators
        if int(a.trntype) in AT_JOINT
    }
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    return spec, repairs, motors


class StatedActuator(NamedTuple):
    """Gains kp (N m/rad) and kd (N m s/rad) of a position actuator, zero for a motor, and largest
    torque (N m, infinite: not stated) of a joint; slides: N, m."""

    kp: float
    kd: float
    limit: float


def stated_actuators(manifest: Manifest) -> dict[str, StatedActuator]:
    """Return the actuators that the MJCF of a manifest states, by joint: the first one of each.

    Robots have none of them: their inputs are torques.
    """
    found: dict[str, StatedActuator] = {}
    path, text = manifest.path, None if manifest.text is None else manifest.text.encode()
    # As the robot is read: from a text without a file, and with the same repairs.
    for one in _read(path, text, manifest.assets or path.parent)[0].actuators:
        if int(one.trntype) not in AT_JOINT or one.target in found:
            continue
        is_motor = int(one.biastype) == int(mujoco.mjtBias.mjBIAS_NONE)
        low, high = one.forcerange
        if low >= high and is_motor:
            low, high = np.array(one.ctrlrange) * one.gainprm[0]
        # The force of a position servo is kp (ctrl - q) - kd v, with biasprm = [0, -kp, -kd]; a
        # range [-a, b] holds for either sign only up to the smaller one.
        gear = abs(float(one.gear[0]))
        kp, kd = (0.0, 0.0) if is_motor else np.maximum(-one.biasprm[1:3] * gear**2, 0.0).tolist()
        limit = gear * float(min(-low, high))
        found[one.target] = StatedActuator(kp, kd, limit if limit > 0.0 else np.inf)
    return found


def _read(path: Path, text: bytes | None, folder: Path) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """Spec of a file or text; repaired, as the words say, where MuJoCo refuses it as it stands."""
    data = read_file(path) if text is None else text
    check_files(path, data, folder)
    changed = None if text is None else text.decode()
    repairs: tuple[str, ...] = ()
    # MuJoCo names one fault at a time.
    while True:
        try:
            if changed is None:  # MuJoCo finds included files by the path alone
                return mujoco.MjSpec.from_file(str(path)), repairs
            return mujoco.MjSpec.from_string(changed), repairs
        except (ValueError, mujoco.FatalError) as error:
            changed, more = repair_mjcf(path, data, str(error))
            if not more or set(more) <= set(repairs):
                reason = " ".join(str(error).split())
                raise ModelError(f"MuJoCo cannot read {path.name}: {reason}") from error
            data, repairs = changed.encode(), repairs + more
