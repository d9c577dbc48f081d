"""One canonical text per URDF, given to both engines.

Visual and collision shapes are removed, fixed links are kept. Only links that MuJoCo would reject
are repaired (inertia_repair.py); each repair is reported, as a part of the simulated truth.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.checks.unit_checks import angle_warnings
from sysid_bench.models.urdf.inertia_repair import repair_inertias
from sysid_bench.models.urdf.link_tree import LinkTree, link_tree
from sysid_bench.models.urdf.urdf_joints import canonical_joints
from sysid_bench.models.urdf.xml_numbers import check_origin, finite_number
from sysid_bench.models.xml_file import parse_xml

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
    tree = link_tree(robot, name)
    mimic = tuple(_take_mimics(robot, name))
    if free_base:
        tree = _without_world(robot, tree, name)
    removed += _rename_worlds(robot, tree, free_base)
    tree = link_tree(robot, name)
    robot.attrib.setdefault("name", "robot")  # Pinocchio insists
    limits = canonical_joints(robot, tree.root, name)
    repairs = repair_inertias(robot, tree, name, free_base)
    compiler = ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler")
    compiler.set("fusestatic", "false")
    return Urdf(
        ET.tostring(robot, encoding="unicode"),
        (*repairs, *limits, *removed, *angle_warnings(robot)),
        _velocity_limits(robot, name),
        mimic,
    )


def _remove_unused(robot: ET.Element) -> Iterator[str]:
    """Remove shapes and extensions; report settings of MuJoCo's extension that would matter."""
    for link in robot.findall("link"):
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    for section in robot.findall("mujoco"):
        written = [f"{part.tag} {key}" for part in section for key in part.attrib]
        if given := [words for words in written if words not in _NO_DYNAMICS]:
            yield f"left out of the <mujoco> extension: {', '.join(given)}"
    for tag in ("mujoco", "gazebo", "transmission", "material", "sensor"):
        for element in robot.findall(tag):
            robot.remove(element)


def _take_mimics(robot: ET.Element, name: str) -> Iterator[Mimic]:
    for joint in robot.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
            label = f"{name}: the mimic of joint {joint.get('name')!r}"
            multiplier = finite_number(mimic, "multiplier", label, default=1.0)
            offset = finite_number(mimic, "offset", label, default=0.0)
            yield Mimic(str(joint.get("name")), mimic.get("joint"), multiplier, offset)


def _without_world(robot: ET.Element, tree: LinkTree, name: str) -> LinkTree:
    """Take out a root link called `world`: it is the ground, and a floating robot begins below."""
    kinds = [kind for _, kind in tree.below.get(tree.root, [])]
    weighs = tree.links[tree.root].find("inertial") is not None
    if tree.root != "world" or weighs or kinds not in (["fixed"], ["floating"]):
        return tree
    robot.remove(tree.links["world"])
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        if parent is not None and parent.get("link") == "world":
            robot.remove(joint)
    return link_tree(robot, name)


def _rename_worlds(robot: ET.Element, tree: LinkTree, free_base: bool) -> Iterator[str]:
    """Rename a moving link called `world`: MuJoCo takes every link of that name for the ground."""
    if "world" not in tree.links or (tree.root == "world" and not free_base):
        return
    new = "world_"
    while new in tree.links:
        new += "_"
    tree.links["world"].set("name", new)
    for end in (*robot.findall("joint/parent"), *robot.findall("joint/child")):
        if end.get("link") == "world":
            end.set("link", new)
    yield f"moving link 'world' renamed {new!r}"


def _velocity_limits(robot: ET.Element, name: str) -> dict[str, float]:
    """Velocity limits by joint (rad/s, m/s): MuJoCo knows none. Checks all limits and origins."""
    found = {}
    for joint in robot.findall("joint"):
        limit = joint.find("limit")
        label = f"{name}: joint {joint.get('name')!r}"
        for key in ("lower", "upper", "effort", "velocity"):
            if limit is not None and limit.get(key) is not None:
                finite_number(limit, key, label)
        if limit is not None and float(limit.get("velocity", 0.0)) > 0:
            found[str(joint.get("name"))] = float(limit.get("velocity", 0.0))
        check_origin(joint.find("origin"), label)
    return found
