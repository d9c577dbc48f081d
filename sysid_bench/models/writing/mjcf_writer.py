"""Writing of identified parameters into an MJCF; every other byte of its text stays."""

from collections.abc import Iterator, Mapping, Sequence
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
        values |= inertia_attributes(inertia)
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
        worlds = [section for section in root.children if section.tag == "worldbody"]
        inside = list(chain.from_iterable(section.subtree() for section in worlds))
        bodies = [element for element in inside if element.tag == "body"]
        joints = list(chain.from_iterable(map(_joints_of, bodies)))
        self.elements = {"body": bodies, "joint": joints}
        self.names = {"body": robot.body_names, "joint": [joint.name for joint in robot.joints]}
        self.copied = [element.tag for element in inside if element.tag in _COPIES]
        self.included = any(element.tag == "include" for element in root.subtree())
        self.file = robot.manifest.path.name

    def find(self, kind: str, name: str) -> Element:
        """Return the element of the body or joint of a name."""
        elements, names = self.elements[kind], list(self.names[kind])
        written = [element.attributes.get("name") for element in elements]
        if written.count(name) == 1:
            element = elements[written.index(name)]
            above: Element | None = element
            while above is not None and above.tag not in _COPIES:
                above = above.parent
            if above is None:
                return element
        # An unnamed one is found by its index where the elements are those of the robot, one by
        # one: bodies are numbered in the order of the text, joints body by body.
        in_order = not self.copied and len(written) == len(names)
        if name not in written and in_order and all(map(_fits, written, names)):
            return elements[names.index(name)]
        obstacle = "it is not in the text"
        if self.copied:
            obstacle = f"<{self.copied[0]}> creates it, and a change would affect its copies"
        elif self.included:
            obstacle = "it comes from an included file; write that file's content into this one"
        raise ModelError(f"{self.file}: the {kind} {name!r} cannot be written: {obstacle}.")


def _fits(written: str | None, name: str) -> bool:
    return written is None or written == name


def _joints_of(body: Element) -> Iterator[Element]:
    """The joint elements of one body, also within its frames."""
    for child in body.children:
        if child.tag in ("joint", "freejoint"):
            yield child
        elif child.tag == "frame":
            yield from _joints_of(child)


def inertia_attributes(inertia: Array) -> dict[str, str | None]:
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
        value = _joint_share(spec, name, key, total) if key in ("armature", "damping") else total
        if key == "springref" and in_degrees:
            value = np.rad2deg(value)
        # Damping and stiffness are polynomials; coefficients beyond the linear one stay.
        written = getattr(source, key) if key in ("damping", "stiffness") else ()
        values[key] = values_text(value, *np.trim_zeros(np.ravel(written)[1:], "b"))
    yield from edit_values(data, joint, values)


def _joint_share(spec: mujoco.MjSpec, joint: str, key: str, total: float) -> float:
    """The value to write at a joint for a total armature or damping: MuJoCo adds those of
    actuators, times the gear squared. Raises ModelError where these alone exceed the total."""
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
        words = {
            "name": name, "joint": self.joint, "gear": "1", "dyntype": "none",
            "gaintype": "fixed", "gainprm": values_text(self.kp), "biastype": "affine",
            "biasprm": values_text(-self.offset, -self.kp, -self.kd), "ctrllimited": "false",
            "forcelimited": str(bool(np.isfinite(self.limit))).lower(),
        }  # fmt: skip
        if np.isfinite(self.limit):
            # MuJoCo limits the force with its bias, so the limits move with the offset.
            ends = -self.limit - self.offset, self.limit - self.offset
            words["forcerange"] = values_text(*ends)
        if self.delay:
            words |= {"delay": values_text(self.delay), "nsample": str(self.samples)}
        return f"<general {' '.join(f'{k}={quoteattr(x)}' for k, x in words.items())}/>"


def with_position_actuators(text: str, actuators: Sequence[PositionDrive], name: str) -> str:
    """Return the text of an MJCF in which each actuator replaces the first one of its joint, under
    its name, so that sensors and keyframes still find it; others are added.

    Raises ModelError, with `name`, for a text that is not well-formed XML.
    """
    data = text.encode()
    root = element_tree(data, name)
    sections = [child for child in root.children if child.tag == SECTION]
    present = list(chain.from_iterable(section.children for section in sections))
    edits, added = [], []
    for actuator in actuators:
        of_joint = [one for one in present if one.attributes.get("joint") == actuator.joint]
        label = f"{actuator.joint}_position"
        if not of_joint:
            added.append(actuator.element(label))
        for k, one in enumerate(of_joint):
            new = "" if k else actuator.element(one.attributes.get("name", label))
            end = one.tail if one.empty else data.index(b">", one.tail) + 1
            edits.append(Edit(one.start, end, new))
    if added:
        edits.append(_added_actuators(data, root, added))
    return edit_text(data, edits)


def _added_actuators(data: bytes, root: Element, added: Sequence[str]) -> Edit:
    """The edit that puts elements into the first section of actuators, or into a new one."""
    section = next((child for child in root.children if child.tag == SECTION), None)
    if section is not None:
        return element_edit(data, section, "\n".join(added))
    lines = "".join(f"    {one}\n" for one in added)
    return Edit(root.tail, root.tail, f"\n  <{SECTION}>\n{lines}  </{SECTION}>\n")
