"""Joints of a URDF: types that both engines read, and limits that both parsers accept."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Set
from itertools import chain
from typing import Final

from sysid_bench.errors import ModelError, unknown_name
from sysid_bench.models.urdf.link_tree import link_at

KINDS: Final = ("revolute", "continuous", "prismatic", "fixed", "planar", "floating", "spherical")
"""Planar becomes two slides and a hinge; spherical, which is MuJoCo's own addition, a ball."""

PLANAR_PARTS: Final = {"_TX": "prismatic", "_TY": "prismatic", "_RZ": "continuous"}
"""Suffixes of the joints that MuJoCo makes of a planar one, and their types."""


def canonical_joints(robot: ET.Element, root: str, name: str) -> tuple[str, ...]:
    """Check the types of joints and complete their limits in place; return the changes in words.

    Raises ModelError for an unknown type, and for a floating joint that is not at the ground, where
    MuJoCo has none.
    """
    joints = robot.findall("joint")
    names = {joint.get("name") for joint in joints}
    for joint in joints:
        _check_joint(joint, root, names, name)
    return tuple(chain.from_iterable(map(_complete_limits, filter(_needs_limits, joints))))


def _check_joint(joint: ET.Element, root: str, names: Set[str | None], name: str) -> None:
    _check_type(joint, name)
    if joint.get("type") == "floating":
        _check_floating(joint, root, name)
    if joint.get("type") == "planar":
        _check_planar(joint, names, name)


def _check_type(joint: ET.Element, name: str) -> None:
    kind = joint.get("type")
    if kind is None:
        raise ModelError(f"{name}: joint {joint.get('name')!r} has no type: {', '.join(KINDS)}.")
    if kind not in KINDS:
        reason = unknown_name("kind of joint", kind, KINDS)
        raise ModelError(f"{name}: joint {joint.get('name')!r}: {reason}")


def _check_floating(joint: ET.Element, root: str, name: str) -> None:
    above = link_at(joint, "parent")
    if not (above == root == "world"):
        raise ModelError(
            f"{name}: the floating joint {joint.get('name')!r} is attached to "
            f"{above!r}; only a root link called 'world' may carry one. Remove the joint and ask "
            "for a free base, or make it fixed."
        )


def _check_planar(joint: ET.Element, names: Set[str | None], name: str) -> None:
    """Raise ModelError where a joint has the name of a part that MuJoCo makes of this one."""
    parts = {f"{joint.get('name')}{part}" for part in PLANAR_PARTS}
    if parts & names:
        raise ModelError(
            f"{name}: the planar joint {joint.get('name')!r} becomes {', '.join(sorted(parts))}"
            f", and another joint is called {min(parts & names)!r}; rename that one."
        )


def _needs_limits(joint: ET.Element) -> bool:
    return joint.get("type") in ("revolute", "prismatic")


def _complete_limits(joint: ET.Element) -> Iterator[str]:
    """Complete limits: Pinocchio refuses absent ones; zero means "no limit" to both engines."""
    label = f"joint {joint.get('name')!r}"
    limit = joint.find("limit")
    if limit is None:
        limit = ET.SubElement(joint, "limit")
        yield f"{label} has no limits: unlimited"
    limit.attrib.update({"effort": "0", "velocity": "0"} | limit.attrib)
    if _reversed(limit):
        yield f"the limits of {label} are reversed: unlimited"


def _reversed(limit: ET.Element) -> bool:
    try:
        return float(limit.get("lower", "0")) > float(limit.get("upper", "0"))
    except ValueError:
        return False  # refused by finite_value, with the value
