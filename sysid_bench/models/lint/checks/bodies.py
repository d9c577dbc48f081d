"""Masses, centres of mass and moments against the size of each body and of the robot."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import chain
from typing import Final

import numpy as np

from sysid_bench.errors import first_names
from sysid_bench.models.checks.placeholder_inertia import placeholder_reason
from sysid_bench.models.lint.finding import LintFinding, Severity
from sysid_bench.models.lint.lint_input import BodyMass, LintInput
from sysid_bench.models.tree import FREE
from sysid_bench.types import Array, BodyExtents

STEEL: Final = 8000.0
"""kg/m^3; the box around a link has no higher mean density."""

TOO_DENSE: Final = 3.0
"""Densities above this many times that of steel are errors: gold has 2.4."""

LIGHT: Final = 1.0
"""kg/m^3; below it the mass of a link that carries a motor is in a wrong unit, or not there."""

WIDE: Final = 1.5
"""Radius of gyration over the half diagonal of the box from which on the moments are too large."""

NARROW: Final = 0.02
"""The same from which on they are too small."""

HEAVY: Final = 2000.0
"""kg; sum of masses of a robot above which the sum is named."""

EXCHANGED: Final = 1.5
"""Ratio between the moments along and across a long link from which on they look exchanged."""


def placeholder_inertia(model: LintInput) -> Iterator[LintFinding]:
    """Inertias that stand for none: equal on all links, for a sphere of the whole robot."""
    if reason := placeholder_reason(model.robot):
        yield LintFinding(
            "placeholder-inertia", "warning", "", reason,
            "give every link its own mass and inertia; no prior is taken from these",
        )  # fmt: skip


def mass_size(model: LintInput) -> Iterator[LintFinding]:
    """Masses that no link of that size has, moving links without mass, and the sum of masses."""
    for i in model.moving:
        yield from _mass(model, model.bodies[i])
    total = sum(model.bodies[i].mass for i in model.moving)
    if total > HEAVY:
        yield LintFinding(
            "sum-of-masses", "warning", "", f"the moving bodies weigh {total:.4g} kg",
            "masses are in kg",
        )  # fmt: skip


def _mass(model: LintInput, body: BodyMass) -> Iterator[LintFinding]:
    extent = model.extents.get(body.name)
    if extent is None:
        return
    density = body.mass / extent.volume
    if density > STEEL:
        severity: Severity = "error" if density > TOO_DENSE * STEEL else "warning"
        yield LintFinding(
            "mass", severity, body.name,
            f"{body.mass:.4g} kg in a box of {extent.volume:.2g} m^3 is denser than steel",
            "masses are in kg, lengths in m",
        )  # fmt: skip
    elif body.mass > 1e-6 and density < LIGHT and _is_real(model, body):
        yield LintFinding(
            "mass", "warning", body.name,
            f"{body.mass:.4g} kg in a box of {extent.volume:.2g} m^3 is lighter than foam",
            "masses are in kg; a frame without mass is welded, not jointed",
        )  # fmt: skip


def _is_real(model: LintInput, body: BodyMass) -> bool:
    """True for a body with joints of its own and shapes: more than a frame of the file."""
    index = model.robot.body_names.index(body.name) + 1  # MuJoCo counts the world
    return bool(model.robot.mj.body_jntnum[index] and model.robot.mj.body_geomnum[index])


def missing_mass(model: LintInput) -> Iterator[LintFinding]:
    """Moving links without mass or without inertia, which the reader completes."""
    for word, what in (("massless", "mass"), ("point mass", "moments of inertia")):
        names = [_quoted(repair) for repair in model.robot.repairs if word in repair]
        if word == "massless":
            names = list(dict.fromkeys((*names, *_shaped_without_mass(model))))
        if names:
            yield LintFinding(
                "missing-mass", "warning", names[0],
                f"{len(names)} links have no {what}: {first_names(names)}",
                "give each its inertial, or weld it",
            )  # fmt: skip


def _shaped_without_mass(model: LintInput) -> Iterator[str]:
    """Links of a URDF that a joint moves and that have a shape, but no inertial."""
    moved = _moved_links(model.root)
    for link in model.root.findall("link"):
        if link.get("name") in moved and _is_shape_alone(link):
            yield str(link.get("name"))


def _moved_links(root: ET.Element) -> set[str | None]:
    """Names of the links that a joint of a URDF moves."""
    joints = (joint for joint in root.findall("joint") if joint.get("type") != "fixed")
    children = chain.from_iterable(joint.findall("child") for joint in joints)
    return {child.get("link") for child in children}


def _is_shape_alone(link: ET.Element) -> bool:
    """True for a link with a shape and without an inertial."""
    is_shaped = link.find("visual") is not None or link.find("collision") is not None
    return is_shaped and link.find("inertial") is None


def _quoted(repair: str) -> str:
    """The name in the words of a repair."""
    return repair.partition("'")[2].partition("'")[0]


def mass_positions(model: LintInput) -> Iterator[LintFinding]:
    """Centres of mass outside of their links."""
    for _, body, extent in _bodies_with_mass(model):
        outside = float(np.maximum(extent.low - body.com, body.com - extent.high).max())
        if outside > 0:
            yield LintFinding(
                "centre-of-mass", "warning", body.name,
                f"the centre of mass lies {outside:.2g} m outside of the link",
                "it is in m, in the frame of the link",
            )  # fmt: skip


def inertia_size(model: LintInput) -> Iterator[LintFinding]:
    """Moments of inertia for another size or direction than that of the link."""
    for i, body, extent in _bodies_with_mass(model):
        if not _is_point(model, i, body):
            yield from _size(body, extent)
            yield from _direction(model, i, body)


def _bodies_with_mass(model: LintInput) -> Iterator[tuple[int, BodyMass, BodyExtents]]:
    """Yield the index, mass and box of each moving body that has a mass and a shape."""
    for i in model.moving:
        body = model.bodies[i]
        extent = model.extents.get(body.name)
        if extent is not None and body.mass > 1e-6:
            yield i, body, extent


def _is_point(model: LintInput, i: int, body: BodyMass) -> bool:
    """True for a body that floats, whose box is unknown, or without moments of its own."""
    joints = model.robot.mj.jnt_type[model.robot.mj.jnt_bodyid == i + 1]
    repaired = any(f"{body.name!r} given the inertia" in text for text in model.robot.repairs)
    return bool((joints == FREE).any()) or repaired or not body.inertia.any()


def _size(body: BodyMass, extent: BodyExtents) -> Iterator[LintFinding]:
    half = 0.5 * float(np.linalg.norm(extent.high - extent.low))
    ratio = body.gyration / half
    if ratio > WIDE or ratio < NARROW * 0.1:
        kind = "large" if ratio > 1 else "small"
        yield LintFinding(
            "moments", "error" if ratio > 10 * WIDE else "warning", body.name,
            f"its radius of gyration is {body.gyration:.2g} m, too {kind} for a link within "
            f"{half:.2g} m",
            "moments are in kg m^2, about the centre of mass",
        )  # fmt: skip


def _direction(model: LintInput, i: int, body: BodyMass) -> Iterator[LintFinding]:
    """A long link turns most easily about its long axis."""
    axis = _long_axis(model, i)
    if axis is None:
        return
    along = float(axis @ body.inertia @ axis)
    across = 0.5 * (float(np.trace(body.inertia)) - along)
    if along > EXCHANGED * across:
        yield LintFinding(
            "moments", "warning", body.name,
            f"the moment about its long axis, {along:.3g} kg m^2, is larger than across it, "
            f"{across:.3g}",
            "look whether moments are exchanged, or the axes of the inertia are others",
        )  # fmt: skip


def _long_axis(model: LintInput, i: int) -> Array | None:
    """Direction to the only child of a link whose mass lies along it; None for any other."""
    children = np.flatnonzero(model.robot.mj.body_parentid == i + 1)
    if len(children) != 1:
        return None
    offset = np.array(model.robot.mj.body_pos[children[0]])
    length = float(np.linalg.norm(offset))
    body = model.bodies[i]
    if length < 0.15 or abs(body.gyration / length - 0.35) > 0.25:
        return None
    aside = body.com - offset * float(body.com @ offset) / length**2
    return offset / length if float(np.linalg.norm(aside)) < 0.25 * length else None
