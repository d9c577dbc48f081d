"""Writing of identified parameters into an MJCF; every other byte of its text stays."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.mjcf.mjcf_terms import AT_JOINT
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.rewrite import rewrite
from sysid_bench.models.writing.round_trip import file_spec
from sysid_bench.models.writing.update import Bodies, Joints, Update
from sysid_bench.models.writing.xml_text import (
    Edit,
    Element,
    attribute_edits,
    element_edit,
    numbers,
)
from sysid_bench.spatial.inertia import mass_com_inertia
from sysid_bench.spatial.rotation import quaternion_of_matrix
from sysid_bench.types import Array

_POSE: Final = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
_COPIES: Final = ("replicate", "composite", "flexcomp", "attach")
"""Elements that create bodies which are not written one by one in the text."""

LAMINA: Final = 1e-9
"""Share of the trace; for a smaller principal moment of the density, principal moments are written,
since MuJoCo may round a full inertia to the impossible side."""

ROUNDING: Final = 1e-9
"""Share of the term that actuators add to a joint; a total below it by less counts as rounding."""


def updated_mjcf(
    path: Path | str,
    bodies: Bodies,
    joints: Joints | None = None,
    verdicts: Mapping[str, str] | None = None,
) -> str:
    """Return the text of an MJCF with new inertial parameters and joint terms; nothing else
    changes.

    `bodies`: name -> phi (10,) or (m, com, inertia about it); `joints`: name -> damping,
    frictionloss, armature, stiffness, springref in SI units; `verdicts`: parameter -> verdict of
    all that is to be written. The text is read again before it is returned. Raises ModelError for
    values that must not be written (see models/writing/update.py), and for included bodies.
    """
    return rewrite(path, bodies, joints, verdicts, "mujoco", _edits)


def _edits(data: bytes, root: Element, update: Update) -> Iterator[Edit]:
    elements = _Elements(root, update.robot)
    for name, phi in update.phi.items():
        yield from _body_edits(data, elements.body(name), phi)
    for name, terms in update.joints.items():
        yield from _joint_edits(data, elements.joint(name), terms, update, name)


class _Elements:
    """Elements of the main file that define the bodies and joints of a robot."""

    def __init__(self, root: Element, robot: RobotModel) -> None:
        world = [section for section in root.children if section.tag == "worldbody"]
        inside = [element for section in world for element in section.subtree()]
        bodies = [element for element in inside if element.tag == "body"]
        joints = [joint for body in bodies for joint in _joints_of(body)]
        self.elements = {"body": bodies, "joint": joints}
        self.names = {"body": robot.body_names, "joint": [joint.name for joint in robot.joints]}
        self.copied = [e.tag for e in inside if e.tag in _COPIES]
        self.included = any(e.tag == "include" for e in root.subtree())
        self.file = robot.manifest.path.name

    def body(self, name: str) -> Element:
        return self._find("body", name)

    def joint(self, name: str) -> Element:
        return self._find("joint", name)

    def _find(self, kind: str, name: str) -> Element:
        elements, names = self.elements[kind], self.names[kind]
        named = [element for element in elements if element.attributes.get("name") == name]
        if len(named) == 1 and not self._copied(named[0]):
            return named[0]
        # Bodies are numbered in the order of the text, joints body by body: an unnamed one is found
        # by its index, if all named ones are at theirs.
        if not named and not self.copied and _in_order(elements, names):
            return elements[list(names).index(name)]
        if self.copied:
            reason = f"<{self.copied[0]}> creates it, and a change would affect its copies"
        elif self.included:
            reason = "it comes from an included file; write that file's content into this one"
        else:
            reason = "it is not in the text"
        raise ModelError(f"{self.file}: the {kind} {name!r} cannot be written: {reason}.")

    def _copied(self, element: Element | None) -> bool:
        while element is not None:
            if element.tag in _COPIES:
                return True
            element = element.parent
        return False


def _joints_of(body: Element) -> Iterator[Element]:
    """The joint elements of one body, also within its frames."""
    for child in body.children:
        if child.tag in ("joint", "freejoint"):
            yield child
        elif child.tag == "frame":
            yield from _joints_of(child)


def _in_order(elements: Sequence[Element], names: Sequence[str]) -> bool:
    return len(elements) == len(names) and all(
        element.attributes.get("name", name) == name
        for element, name in zip(elements, names, strict=True)
    )


def _body_edits(data: bytes, body: Element, phi: Array) -> Iterator[Edit]:
    inertial = body.child("inertial")
    mass, com, inertia = mass_com_inertia(phi)
    values: dict[str, str | None] = {"pos": numbers(*com), "mass": numbers(mass)}
    values |= _inertia(inertia)
    if inertial is not None:
        yield from attribute_edits(data, inertial, {**dict.fromkeys(_POSE), **values})
    elif phi.any() or body.child("geom") is not None:
        words = " ".join(f'{key}="{value}"' for key, value in values.items() if value is not None)
        yield element_edit(data, body, f"<inertial {words}/>")


def _inertia(inertia: Array) -> dict[str, str | None]:
    """Attributes of an inertia (3, 3) about the centre of mass: xx yy zz xy xz yz, or, for a
    lamina, principal moments and their axes."""
    density = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    if density[0] > LAMINA * np.trace(inertia):
        full = inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
        return {"fullinertia": numbers(*full), "diaginertia": None}
    moments, axes = np.linalg.eigh(inertia)
    moments = np.maximum(moments, 0.0)
    moments[2] = min(moments[2], moments[0] + moments[1])  # a lamina lies on the border
    quat = quaternion_of_matrix(axes * np.sign(np.linalg.det(axes)))
    return {"diaginertia": numbers(*moments), "quat": numbers(*quat), "fullinertia": None}


def _joint_edits(
    data: bytes, joint: Element, terms: Mapping[str, float], update: Update, name: str
) -> Iterator[Edit]:
    j = update.robot.mj.joint(name).id
    spec = file_spec(update.robot)
    source = list(spec.joints)[j]
    values: dict[str, str | None] = {}
    for key, total in terms.items():
        value = _joint_share(spec, name, key, total)
        # Damping and stiffness are polynomials: coefficients beyond the linear one stay.
        written = getattr(source, key) if key in ("damping", "stiffness") else ()
        higher = np.trim_zeros(np.ravel(written)[1:], "b")
        if key == "springref" and update.robot.joints[j].kind == "hinge":
            value = np.rad2deg(value) if update.robot.spec.compiler.degree else value
        values[key] = numbers(value, *higher)
    yield from attribute_edits(data, joint, values)


def _joint_share(spec: mujoco.MjSpec, joint: str, key: str, total: float) -> float:
    """The value to write at a joint for a total term: MuJoCo adds the armature and damping of
    actuators, times the gear squared. Raises ModelError where these alone exceed the total.
    """
    if key not in ("armature", "damping"):
        return total
    parts = {
        actuator.name or f"of {joint}": float(actuator.gear[0]) ** 2
        * float(np.ravel(getattr(actuator, key))[0])
        for actuator in spec.actuators
        if actuator.target == joint and int(actuator.trntype) in AT_JOINT
    }
    added = sum(parts.values())
    share = total - added
    if share < -ROUNDING * added:
        raise ModelError(
            f"Not written: {key} of the joint {joint!r} is {total:.4g}, less than the {added:.4g} "
            f"that the actuator {', '.join(name for name, part in parts.items() if part)} adds to "
            "it; change the actuator first."
        )
    return max(share, 0.0) if added else total
