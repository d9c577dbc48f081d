"""One canonical text per URDF, given to both engines.

Visual and collision shapes are removed, fixed links are kept. Only links that MuJoCo would reject
are repaired (inertia_repair.py); each repair is reported, as a part of the simulated truth.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.checks.unit_checks import urdf_warnings
from sysid_bench.models.urdf.inertia_repair import repair_inertia
from sysid_bench.models.urdf.link_tree import LinkTree, link_at, link_tree
from sysid_bench.models.urdf.urdf_joints import canonical_joints
from sysid_bench.models.urdf.urdf_repair import check_has_inertia, repair_urdf
from sysid_bench.models.urdf.xml_values import finite_value
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
    removed += repair_urdf(robot, name)
    tree = link_tree(robot, name)
    mimic = tuple(_take_mimics(robot, name))
    removed += _name_ground(robot, tree)
    tree = link_tree(robot, name)
    if free_base:
        tree = _without_world(robot, tree, name)
    removed += _rename_worlds(robot, tree, free_base)
    tree = link_tree(robot, name)
    robot.attrib.setdefault("name", "robot")  # Pinocchio insists
    limits = canonical_joints(robot, tree.root, name)
    check_has_inertia(robot, name)
    repairs = repair_inertia(robot, tree, name, free_base)
    compiler = ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler")
    compiler.set("fusestatic", "false")
    return Urdf(
        ET.tostring(robot, encoding="unicode"),
        (*repairs, *limits, *removed, *urdf_warnings(robot)),
        _velocity_limits(robot, name),
        mimic,
    )


def _remove_unused(robot: ET.Element) -> Iterator[str]:
    """Remove shapes and extensions; report settings of MuJoCo's extension that would matter."""
    for section in robot.findall("mujoco"):
        if given := _dynamic_settings(section):
            yield f"left out of the <mujoco> extension: {', '.join(given)}"
    for link in robot.findall("link"):
        _remove_all(link, ("visual", "collision"))
    _remove_all(robot, ("mujoco", "gazebo", "transmission", "material", "sensor"))


def _dynamic_settings(section: ET.Element) -> list[str]:
    written = [f"{part.tag} {key}" for part in section for key in part.attrib]
    return [setting for setting in written if setting not in _NO_DYNAMICS]


def _remove_all(parent: ET.Element, tags: Sequence[str]) -> None:
    for tag in tags:
        for element in parent.findall(tag):
            parent.remove(element)


def _take_mimics(robot: ET.Element, name: str) -> Iterator[Mimic]:
    for joint in robot.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
            yield _parsed_mimic(mimic, str(joint.get("name")), name)


def _parsed_mimic(mimic: ET.Element, joint: str, name: str) -> Mimic:
    label = f"{name}: the mimic of joint {joint!r}"
    multiplier = finite_value(mimic, "multiplier", label, default=1.0)
    offset = finite_value(mimic, "offset", label, default=0.0)
    return Mimic(joint, mimic.get("joint"), multiplier, offset)


def _without_world(robot: ET.Element, tree: LinkTree, name: str) -> LinkTree:
    """Take out a root link called `world`: it is the ground, and a floating robot begins below."""
    if not _has_ground(tree):
        return tree
    robot.remove(tree.links["world"])
    for joint in robot.findall("joint"):
        if link_at(joint, "parent") == "world":
            robot.remove(joint)
    return link_tree(robot, name)


def _has_ground(tree: LinkTree) -> bool:
    """True where the root is a massless link `world` with one fixed or floating joint."""
    return tree.root == "world" and _root_joint(tree) in ("fixed", "floating")


def _root_joint(tree: LinkTree) -> str:
    """Type of the one joint at a massless root link; "" for other roots."""
    kinds = [kind for _, kind in tree.below.get(tree.root, [])]
    weighs = tree.links[tree.root].find("inertial") is not None
    return kinds[0] if len(kinds) == 1 and not weighs else ""


def _name_ground(robot: ET.Element, tree: LinkTree) -> Iterator[str]:
    """Give the name `world` to a massless root link that carries a floating joint: MuJoCo floats
    what hangs on that name alone, Pinocchio what hangs on any."""
    root = tree.root
    if root == "world" or "world" in tree.links or _root_joint(tree) != "floating":
        return
    tree.links[root].set("name", "world")
    _rename_ends(robot, root, "world")
    yield f"root link {root!r}, which has no mass and carries the floating joint, is the ground"


def _rename_worlds(robot: ET.Element, tree: LinkTree, free_base: bool) -> Iterator[str]:
    """Rename a moving link called `world`: MuJoCo takes every link of that name for the ground."""
    grounded = tree.root == "world" and not free_base
    if grounded or "world" not in tree.links:
        return
    new = _free_name("world_", tree)
    tree.links["world"].set("name", new)
    _rename_ends(robot, "world", new)
    yield f"moving link 'world' renamed {new!r}"


def _rename_ends(robot: ET.Element, old: str, new: str) -> None:
    """Make the joints at a link follow its new name."""
    for end in (*robot.findall("joint/parent"), *robot.findall("joint/child")):
        if end.get("link") == old:
            end.set("link", new)


def _free_name(name: str, tree: LinkTree) -> str:
    while name in tree.links:
        name += "_"
    return name


def _velocity_limits(robot: ET.Element, name: str) -> dict[str, float]:
    """Velocity limits by joint (rad/s, m/s): MuJoCo knows none. Checks all limits."""
    found = {}
    for joint in robot.findall("joint"):
        label = f"{name}: joint {joint.get('name')!r}"
        velocity = _velocity_limit(joint.find("limit"), label)
        if velocity > 0:  # zero means "no limit" to both engines
            found[str(joint.get("name"))] = velocity
    return found


def _velocity_limit(limit: ET.Element | None, label: str) -> float:
    """Velocity of a <limit>, 0 where it has none; all its numbers are checked."""
    if limit is None:
        return 0.0
    for key in ("lower", "upper", "effort", "velocity"):
        finite_value(limit, key, label, default=0.0)
    return float(limit.get("velocity", 0.0))
