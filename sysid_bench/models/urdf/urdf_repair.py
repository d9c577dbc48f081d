"""Faults of URDF files that ROS reads over, mended so that both engines get the same text.

Of repeated elements ROS (urdfdom) and Pinocchio read the first; MuJoCo refuses the file.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.urdf.xml_values import check_numbers, check_origin, finite_value

_ONCE: Final = {
    "link": ("inertial",),
    "joint": (
        *("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
        *("calibration", "safety_controller"),
    ),
    "inertial": ("origin", "mass", "inertia"),
}
"""Elements of which both formats know one."""

_NUMBERS: Final = {
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
}


def repair_urdf(robot: ET.Element, name: str) -> Iterator[str]:
    """Mend repeated elements and inertials without mass in place; yield the changes in words.

    Raises ModelError, with the file's `name`, for unexpanded xacro and for attributes of links and
    joints that must be numbers and are not.
    """
    _check_expanded(robot, name)
    if unexpanded := [part for part in robot if part.tag.startswith("xacro:")]:
        yield f"{len(unexpanded)} unexpanded <{unexpanded[0].tag}> elements left out"
        for part in unexpanded:
            robot.remove(part)
    for tag in ("link", "joint"):
        for part in robot.findall(tag):
            yield from _mend_part(part, f"{tag} {part.get('name')!r}")
            _check_numbers(part, f"{name}: {tag} {part.get('name')!r}")


def check_has_inertia(robot: ET.Element, name: str) -> None:
    """Raise ModelError for a URDF that moves and in which no link has a mass: it describes no
    dynamics."""
    links = robot.findall("link")
    weighing = [link for link in links if _mass(link, f"{name}: link {link.get('name')!r}") != 0]
    moves = any(joint.get("type") != "fixed" for joint in robot.findall("joint"))
    if not weighing and moves:
        raise ModelError(
            f"{name} is not a model of dynamics: none of its {len(links)} links has a mass; use a "
            "file with <inertial> elements."
        )


def _mass(link: ET.Element, label: str) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else finite_value(mass, "value", label)


def _check_expanded(robot: ET.Element, name: str) -> None:
    for part in (*robot.findall("link"), *robot.findall("joint")):
        for element in part.iter():
            for key, value in element.attrib.items():
                if "$(" in value or "${" in value:
                    raise ModelError(
                        f"{name}: {part.tag} {part.get('name')!r} has {key}={value!r}, which xacro "
                        "has not expanded: run 'xacro FILE.xacro > FILE.urdf', and give the result."
                    )


def _mend_part(part: ET.Element, label: str) -> Iterator[str]:
    """Keep the first of repeated elements; take an inertial without mass for massless."""
    yield from _keep_first(part, part.tag, label)
    inertial = part.find("inertial")
    if inertial is None:
        return
    yield from _keep_first(inertial, "inertial", label)
    if inertial.find("mass") is None:
        part.remove(inertial)
        yield f"{label} has an <inertial> without mass: taken for massless"


def _keep_first(part: ET.Element, kind: str, label: str) -> Iterator[str]:
    for tag in _ONCE[kind]:
        others = part.findall(tag)[1:]
        for element in others:
            part.remove(element)
        if others:
            yield f"{len(others) + 1} <{tag}> elements in {label}: the first is used, as ROS does"


def _check_numbers(part: ET.Element, label: str) -> None:
    for origin in (*part.findall("origin"), *part.findall("inertial/origin")):
        check_origin(origin, label)
    for axis in part.findall("axis"):
        check_numbers(axis, "xyz", label, default="1 0 0")
    for tag, keys in _NUMBERS.items():
        for element in part.findall(tag):
            for key in keys:
                finite_value(element, key, label, default=0.0)
