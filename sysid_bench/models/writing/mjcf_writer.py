"""Writing of identified parameters into an MJCF; every other byte of its text stays."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.models.mjcf import AT_JOINT
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.writing.update import Bodies, Joints, Update, file_spec, update_text
from sysid_bench.models.writing.xml_text import (
    Edit,
    Element,
    edit_text,
    edit_values,
    element_edit,
    element_tree,
    values_text,
)
from sysid_bench.spatial import body_mass_inertia, quaternion_of_matrix
from sysid_bench.types import Array

_POSE: Final = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
_COPIES: Final = ("replicate", "composite", "flexcomp", "attach")
"""Elements that create bodies which are not written one by one in the text."""

LAMINA: Final = 1e-9
"""Share of the trace; for a smaller principal moment of the density, principal moments are written,
since MuJoCo may round a full inertia to the impossible side."""

ROUNDING: Final = 1e-9
"""Share of the term that actuators add to a joint; a total below it by less counts as rounding."""


def update_mjcf(
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
    return update_text(path, bodies, joints, verdicts, "mujoco", _edits)


def _edits(data: bytes, root: Element, update: Update) -> Iterator[Edit]:
    elements = _Elements(root, update.robot)
    for name, phi in update.phi.items():
        body = elements.find("body", name)
        inertial = body.find("inertial")
        mass, com, inertia = body_mass_inertia(phi)
        values: dict[str, str | None] = {"pos": values_text(*com), "mass": values_text(mass)}
        values |= _inertia(inertia)
        if inertial is not None:
            yield from edit_values(data, inertial, {**dict.fromkeys(_POSE), **values})
        # Without an <inertial> MuJoCo would take the inertia of the shapes.
        elif phi.any() or body.find("geom") is not None:
            written = (f'{key}="{value}"' for key, value in values.items() if value is not None)
            yield element_edit(data, body, f"<inertial {' '.join(written)}/>")
    for name, terms in update.joints.items():
        yield from _joint_edits(data, elements.find("joint", name), terms, update, name)


class _Elements:
    """Elements of the main file that define the bodies and joints of a robot."""

    def __init__(self, root: Element, robot: RobotModel) -> None:
        world = _tagged(root.children, "worldbody")
        inside = list(chain.from_iterable(section.subtree() for section in world))
        bodies = _tagged(inside, "body")
        joints = list(chain.from_iterable(map(_joints_of, bodies)))
        self.elements = {"body": bodies, "joint": joints}
        self.names = {"body": robot.body_names, "joint": [joint.name for joint in robot.joints]}
        self.copied = [element.tag for element in _tagged(inside, *_COPIES)]
        self.included = bool(_tagged(root.subtree(), "include"))
        self.file = robot.manifest.path.name

    def find(self, kind: str, name: str) -> Element:
        """Return the element of the body or joint of a name."""
        elements, names = self.elements[kind], self.names[kind]
        named = [element for element in elements if element.attributes.get("name") == name]
        if len(named) == 1 and not _is_copied(named[0]):
            return named[0]
        if not named and self._is_in_order(kind):
            return elements[list(names).index(name)]
        obstacle = "it is not in the text"
        if self.copied:
            obstacle = f"<{self.copied[0]}> creates it, and a change would affect its copies"
        elif self.included:
            obstacle = "it comes from an included file; write that file's content into this one"
        raise ModelError(f"{self.file}: the {kind} {name!r} cannot be written: {obstacle}.")

    def _is_in_order(self, kind: str) -> bool:
        """True where the elements are those of the robot, one by one: bodies are numbered in the
        order of the text, joints body by body. An unnamed one is then found by its index."""
        elements, names = self.elements[kind], self.names[kind]
        if self.copied or len(elements) != len(names):
            return False
        pairs = zip(elements, names, strict=True)
        return all(element.attributes.get("name", name) == name for element, name in pairs)


def _tagged(elements: Iterable[Element], *tags: str) -> list[Element]:
    return [element for element in elements if element.tag in tags]


def _is_copied(element: Element | None) -> bool:
    while element is not None and element.tag not in _COPIES:
        element = element.parent
    return element is not None


def _joints_of(body: Element) -> Iterator[Element]:
    """The joint elements of one body, also within its frames."""
    for child in body.children:
        if child.tag in ("joint", "freejoint"):
            yield child
        elif child.tag == "frame":
            yield from _joints_of(child)


def _inertia(inertia: Array) -> dict[str, str | None]:
    """Attributes of an inertia (3, 3) about the centre of mass: xx yy zz xy xz yz, or, for a
    lamina, principal moments and their axes."""
    density = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    if density[0] > LAMINA * np.trace(inertia):
        full = inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
        return {"fullinertia": values_text(*full), "diaginertia": None}
    moments, axes = np.linalg.eigh(inertia)
    # Rounding may take the moments of a point mass or rod below zero.
    moments = np.maximum(moments, 0.0)
    moments[2] = min(moments[2], moments[0] + moments[1])  # a lamina lies on the border
    # Eigenvectors may form a reflection, which a quaternion cannot express.
    quat = quaternion_of_matrix(axes * np.sign(np.linalg.det(axes)))
    return {"diaginertia": values_text(*moments), "quat": values_text(*quat), "fullinertia": None}


def _joint_edits(
    data: bytes, joint: Element, terms: Mapping[str, float], update: Update, name: str
) -> Iterator[Edit]:
    j = update.robot.mj.joint(name).id
    spec = file_spec(update.robot)
    source = list(spec.joints)[j]
    # Angles of a text are in the unit of its compiler, hinges alone: slides are in metres.
    in_degrees = update.robot.joints[j].kind == "hinge" and bool(update.robot.spec.compiler.degree)
    values: dict[str, str | None] = {}
    for key, total in terms.items():
        value = _joint_share(spec, name, key, total)
        if key == "springref" and in_degrees:
            value = np.rad2deg(value)
        # Damping and stiffness are polynomials; coefficients beyond the linear one stay.
        written = getattr(source, key) if key in ("damping", "stiffness") else ()
        values[key] = values_text(value, *np.trim_zeros(np.ravel(written)[1:], "b"))
    yield from edit_values(data, joint, values)


def _joint_share(spec: mujoco.MjSpec, joint: str, key: str, total: float) -> float:
    """The value to write at a joint for a total term: MuJoCo adds the armature and damping of
    actuators, times the gear squared. Raises ModelError where these alone exceed the total.
    """
    if key not in ("armature", "damping"):
        return total
    # Armature or damping that each actuator adds to a joint.
    parts = {
        actuator.name or f"of {joint}": float(actuator.gear[0]) ** 2
        * float(np.ravel(getattr(actuator, key))[0])
        for actuator in spec.actuators
        if actuator.target == joint and int(actuator.trntype) in AT_JOINT
    }
    added = sum(parts.values())
    share = total - added
    if share < -ROUNDING * added:
        adding = [name for name, part in parts.items() if part]
        raise ModelError(
            f"Not written: {key} of the joint {joint!r} is {total:.4g}, less than the {added:.4g} "
            f"that the actuator {', '.join(adding)} adds to it; change the actuator first."
        )
    return max(share, 0.0) if added else total


SECTION: Final = "actuator"


@dataclass(frozen=True)
class PositionDrive:
    """Actuator of a joint: tau = clip(kp (u(t - delay) - q) - kd v, +- limit) - offset.

    `samples`: length of the buffer that holds past inputs, at least the delay over the time step.
    """

    joint: str
    kp: float
    kd: float
    offset: float
    limit: float
    delay: float
    samples: int

    def element(self, name: str) -> str:
        """Return the XML element; settings of classes that would change it are overridden."""
        words: dict[str, str] = {
            "name": name, "joint": self.joint, "gear": "1", "dyntype": "none",
            "gaintype": "fixed", "gainprm": values_text(self.kp), "biastype": "affine",
            "biasprm": values_text(-self.offset, -self.kp, -self.kd), "ctrllimited": "false",
            **self._limits, **self._buffer,
        }  # fmt: skip
        return f"<general {' '.join(f'{k}={quoteattr(x)}' for k, x in words.items())}/>"

    @property
    def _limits(self) -> Mapping[str, str]:
        if not np.isfinite(self.limit):
            return {"forcelimited": "false"}
        # MuJoCo limits the force with its bias, so the limits move with the offset.
        ends = values_text(-self.limit - self.offset, self.limit - self.offset)
        return {"forcelimited": "true", "forcerange": ends}

    @property
    def _buffer(self) -> Mapping[str, str]:
        if self.delay == 0.0:
            return {}
        return {"delay": values_text(self.delay), "nsample": str(self.samples)}


def with_position_actuators(text: str, actuators: Sequence[PositionDrive], name: str) -> str:
    """Return the text of an MJCF in which each actuator replaces the first one of its joint, under
    its name, so that sensors and keyframes still find it; others are added.

    Raises ModelError, with `name`, for a text that is not well-formed XML.
    """
    data = text.encode()
    root = element_tree(data, name)
    return edit_text(data, _drive_edits(data, root, actuators))


def _drive_edits(data: bytes, root: Element, actuators: Sequence[PositionDrive]) -> Iterator[Edit]:
    sections = [child for child in root.children if child.tag == SECTION]
    present = list(chain.from_iterable(section.children for section in sections))
    added = []
    for actuator in actuators:
        of_joint = [one for one in present if one.attributes.get("joint") == actuator.joint]
        if of_joint:
            first, *others = of_joint
            label = first.attributes.get("name", f"{actuator.joint}_position")
            yield _replacement(data, first, actuator.element(label))
            yield from (_replacement(data, other, "") for other in others)
        else:
            added.append(actuator.element(f"{actuator.joint}_position"))
    if added and sections:
        yield element_edit(data, sections[0], "\n".join(added))
    elif added:
        lines = "".join(f"    {one}\n" for one in added)
        yield Edit(root.tail, root.tail, f"\n  <{SECTION}>\n{lines}  </{SECTION}>\n")


def _replacement(data: bytes, element: Element, text: str) -> Edit:
    """Return the edit that replaces an element with all that is in it."""
    end = element.tail if element.empty else data.index(b">", element.tail) + 1
    return Edit(element.start, end, text)
