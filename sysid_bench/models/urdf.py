"""Canonical text of a URDF that MuJoCo and Pinocchio read alike: faults repaired, limits added."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, product
from typing import Final

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.model_checks import urdf_warnings
from sysid_bench.models.urdf_links import (
    LinkTree,
    check_numbers,
    finite_value,
    free_name,
    link_at,
    link_tree,
    repair_inertia,
)
from sysid_bench.models.xml_file import parse_xml

KINDS: Final = ("revolute", "continuous", "prismatic", "fixed", "planar", "floating", "spherical")
"""Planar becomes two slides and a hinge; spherical, which is MuJoCo's own addition, a ball."""

PLANAR_PARTS: Final = {"_TX": "prismatic", "_TY": "prismatic", "_RZ": "continuous"}
"""Suffixes of the joints that MuJoCo makes of a planar one, and their types."""


def canonical_joints(robot: ET.Element, root: str, name: str) -> Iterator[str]:
    """Check the types of joints and complete their limits in place; yield the changes in words.

    Raises ModelError for an unknown type, and for a floating joint that is not at the ground, where
    MuJoCo has none.
    """
    joints = robot.findall("joint")
    names = {joint.get("name") for joint in joints}
    for joint in joints:
        kind, label = joint.get("type"), f"joint {joint.get('name')!r}"
        if kind is None:
            raise ModelError(f"{name}: {label} has no type: {', '.join(KINDS)}.")
        if kind not in KINDS:
            raise ModelError(f"{name}: {label}: {unknown_name('kind of joint', kind, KINDS)}")
        above = link_at(joint, "parent")
        if kind == "floating" and not (above == root == "world"):
            raise ModelError(
                f"{name}: the floating {label} is attached to {above!r}; only a root link called "
                "'world' may carry one. Remove the joint and ask for a free base, or make it fixed."
            )
        # MuJoCo makes three joints of a planar one, under names that must be free.
        parts = {f"{joint.get('name')}{part}" for part in PLANAR_PARTS}
        if kind == "planar" and parts & names:
            raise ModelError(
                f"{name}: the planar {label} becomes {', '.join(sorted(parts))}, and another "
                f"joint is called {min(parts & names)!r}; rename that one."
            )
    yield from _complete_limits(joints)


def _complete_limits(joints: Sequence[ET.Element]) -> Iterator[str]:
    for joint in (joint for joint in joints if joint.get("type") in ("revolute", "prismatic")):
        label, limit = f"joint {joint.get('name')!r}", joint.find("limit")
        # Pinocchio refuses absent limits; zero means "no limit" to both engines.
        if limit is None:
            limit = ET.SubElement(joint, "limit")
            yield f"{label} has no limits: unlimited"
        limit.attrib.update({"effort": "0", "velocity": "0"} | limit.attrib)
        if float(limit.get("lower", "0")) > float(limit.get("upper", "0")):
            yield f"the limits of {label} are reversed: unlimited"


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
    """Repair repeated elements and inertials without mass in place; yield the changes in words.

    Raises ModelError, with the file's `name`, for unexpanded xacro and for attributes of links and
    joints that must be numbers and are not.
    """
    for part in (*robot.findall("link"), *robot.findall("joint")):
        for key, value in chain.from_iterable(element.attrib.items() for element in part.iter()):
            if "$(" in value or "${" in value:
                raise ModelError(
                    f"{name}: {part.tag} {part.get('name')!r} has {key}={value!r}, which xacro "
                    "has not expanded: run 'xacro FILE.xacro > FILE.urdf', and give the result."
                )
    if unexpanded := [part for part in robot if part.tag.startswith("xacro:")]:
        yield f"{len(unexpanded)} unexpanded <{unexpanded[0].tag}> elements left out"
        for part in unexpanded:
            robot.remove(part)
    for part in (*robot.findall("link"), *robot.findall("joint")):
        label = f"{part.tag} {part.get('name')!r}"
        yield from _keep_first(part, label)
        if (inertial := part.find("inertial")) is not None:
            yield from _keep_first(inertial, label)
            if inertial.find("mass") is None:
                part.remove(inertial)
                yield f"{label} has an <inertial> without mass: taken for massless"
        _check_numbers(part, f"{name}: {label}")


def _keep_first(part: ET.Element, label: str) -> Iterator[str]:
    """Keep the first of repeated elements."""
    for tag in _ONCE[part.tag]:
        others = part.findall(tag)[1:]
        for element in others:
            part.remove(element)
        if others:
            yield f"{len(others) + 1} <{tag}> elements in {label}: the first is used, as ROS does"


def _check_numbers(part: ET.Element, label: str) -> None:
    for origin in (*part.findall("origin"), *part.findall("inertial/origin")):
        check_numbers(origin, "xyz", label)
        check_numbers(origin, "rpy", label)
    for axis in part.findall("axis"):
        check_numbers(axis, "xyz", label, default="1 0 0")
    for tag, keys in _NUMBERS.items():
        for element, key in product(part.findall(tag), keys):
            finite_value(element, key, label, default=0.0)


def check_has_inertia(robot: ET.Element, name: str) -> None:
    """Raise ModelError for a URDF that moves and in which no link has a mass: it describes no
    dynamics."""
    weighs, links = False, robot.findall("link")
    for link in links:
        if (mass := link.find("inertial/mass")) is not None:
            weighs |= finite_value(mass, "value", f"{name}: link {link.get('name')!r}") != 0
    if not weighs and any(joint.get("type") != "fixed" for joint in robot.findall("joint")):
        raise ModelError(
            f"{name} is not a model of dynamics: none of its {len(links)} links has a mass; use a "
            "file with <inertial> elements."
        )


_NO_DYNAMICS: Final = (
    "compiler meshdir", "compiler strippath", "compiler discardvisual", "compiler fusestatic"
)  # fmt: skip
"""Settings of the <mujoco> extension that change no motion."""


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: q = multiplier * q of `driver` + offset."""

    joint: str
    driver: str | None
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Urdf:
    """A canonical URDF: its text, the repairs in words, and what MuJoCo does not read from it."""

    text: str
    repairs: tuple[str, ...]
    velocity_limits: dict[str, float]  # joint -> rad/s or m/s
    mimic: tuple[Mimic, ...]  # taken out of the text: Pinocchio has no regressor for them


def canonical_urdf(text: str | bytes, name: str, free_base: bool = False) -> Urdf:
    """Return the canonical text of a URDF; raises ModelError, with the file's `name`, for errors
    that cannot be repaired."""
    robot = parse_xml(text, name)
    if robot.tag != "robot":
        raise ModelError(f"{name} is not a URDF: its root element is <{robot.tag}>, not <robot>.")
    removed = list(_remove_unused(robot))
    removed += repair_urdf(robot, name)
    tree = link_tree(robot, name)
    mimic = tuple(_take_mimics(robot, name))
    removed += _name_ground(robot, tree)
    tree = link_tree(robot, name)
    # A root link called `world` is the ground: a floating robot begins below.
    if free_base and tree.root == "world" and _root_joint(tree) in ("fixed", "floating"):
        robot.remove(tree.links["world"])
        for joint in robot.findall("joint/parent[@link='world']/.."):
            robot.remove(joint)
        tree = link_tree(robot, name)
    # MuJoCo takes every link of that name for the ground, moving ones, too.
    if "world" in tree.links and (free_base or tree.root != "world"):
        new = free_name("world_", tree.links)
        _rename(robot, tree, "world", new)
        removed.append(f"moving link 'world' renamed {new!r}")
        tree = link_tree(robot, name)
    robot.attrib.setdefault("name", "robot")  # Pinocchio insists
    limits = tuple(canonical_joints(robot, tree.root, name))
    check_has_inertia(robot, name)
    repairs = repair_inertia(robot, tree, name, free_base)
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler").set("fusestatic", "false")
    return Urdf(
        ET.tostring(robot, encoding="unicode"),
        (*repairs, *limits, *removed, *urdf_warnings(robot)),
        _velocity_limits(robot),
        mimic,
    )


def _velocity_limits(robot: ET.Element) -> dict[str, float]:
    """Velocity limits (rad/s, m/s), which MuJoCo does not know; zero means "no limit" to both
    engines."""
    limited = {joint.get("name", ""): joint.find("limit") for joint in robot.findall("joint")}
    stated = {n: float(x.get("velocity", 0.0)) for n, x in limited.items() if x is not None}
    return {joint: v for joint, v in stated.items() if v > 0}


def gear_ratios(robot: ET.Element) -> dict[str, tuple[float, ...]]:
    """Gear ratio of each joint that a <transmission> of a URDF states, which no engine reads."""
    gears: dict[str, tuple[float, ...]] = {}
    for part in robot.iter("transmission"):
        written = next((e.text for e in part.iter("mechanicalReduction")), None)
        with suppress(TypeError, ValueError):  # none, or not a number: nothing is stated
            ratio = float(written)  # type: ignore[arg-type]
            gears |= {joint.get("name", ""): (ratio,) for joint in part.iter("joint")}
    return gears


def _remove_unused(robot: ET.Element) -> Iterator[str]:
    """Remove shapes and extensions; report settings of MuJoCo's extension that would matter."""
    for section in robot.findall("mujoco"):
        written = [f"{part.tag} {key}" for part in section for key in part.attrib]
        if given := [setting for setting in written if setting not in _NO_DYNAMICS]:
            yield f"left out of the <mujoco> extension: {', '.join(given)}"
    shapes, extensions = "visual collision", "mujoco gazebo transmission material sensor"
    for parent, tags in [(link, shapes) for link in robot.findall("link")] + [(robot, extensions)]:
        for element in [part for part in parent if part.tag in tags.split()]:
            parent.remove(element)


def _take_mimics(robot: ET.Element, name: str) -> Iterator[Mimic]:
    for joint in robot.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
            follower = str(joint.get("name"))
            label = f"{name}: the mimic of joint {follower!r}"
            multiplier = finite_value(mimic, "multiplier", label, default=1.0)
            offset = finite_value(mimic, "offset", label, default=0.0)
            yield Mimic(follower, mimic.get("joint"), multiplier, offset)


def _root_joint(tree: LinkTree) -> str:
    """Type of the one joint at a massless root link; "" for other roots."""
    kinds = [kind for _, kind in tree.below.get(tree.root, [])]
    weighs = tree.links[tree.root].find("inertial") is not None
    return kinds[0] if len(kinds) == 1 and not weighs else ""


def _name_ground(robot: ET.Element, tree: LinkTree) -> Iterator[str]:
    """Give the name `world` to a massless root link that carries a floating joint: MuJoCo floats
    what hangs on that name alone, Pinocchio what hangs on any."""
    root = tree.root
    if "world" not in tree.links and _root_joint(tree) == "floating":
        _rename(robot, tree, root, "world")
        yield f"root link {root!r}, which has no mass and carries the floating joint, is the ground"


def _rename(robot: ET.Element, tree: LinkTree, old: str, new: str) -> None:
    """Rename a link, and make the joints at it follow."""
    tree.links[old].set("name", new)
    for end in (*robot.findall("joint/parent"), *robot.findall("joint/child")):
        if end.get("link") == old:
            end.set("link", new)
