"""Rules of the linter on bodies, joints, limbs and inertias as written."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain
from typing import Final

import numpy as np

from sysid_bench.errors import count_text, first_names
from sysid_bench.models.lint_input import BodyMass, LintFinding, LintInput, Severity
from sysid_bench.models.model_checks import placeholder_reason
from sysid_bench.models.tree import FREE, HINGE, SLIDE, Link
from sysid_bench.models.urdf_links import element_inertia, is_feasible, nearest_feasible
from sysid_bench.spatial import inertia_matrix, matrix_of_quaternion, urdf_quaternion
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
        body = model.bodies[i]
        if (extent := model.extents.get(body.name)) is not None:
            yield from _density(model, body, extent)
    total = sum(model.bodies[i].mass for i in model.moving)
    if total > HEAVY:
        yield LintFinding(
            "sum-of-masses", "warning", "", f"the moving bodies weigh {total:.4g} kg",
            "masses are in kg",
        )  # fmt: skip


def _density(model: LintInput, body: BodyMass, extent: BodyExtents) -> Iterator[LintFinding]:
    density = body.mass / extent.volume
    index = model.robot.body_names.index(body.name) + 1  # MuJoCo counts the world
    # With joints of its own and shapes a body is more than a frame of the file.
    is_real = model.robot.mj.body_jntnum[index] and model.robot.mj.body_geomnum[index]
    if density > STEEL:
        severity: Severity = "error" if density > TOO_DENSE * STEEL else "warning"
        yield LintFinding(
            "mass", severity, body.name,
            f"{body.mass:.4g} kg in a box of {extent.volume:.2g} m^3 is denser than steel",
            "masses are in kg, lengths in m",
        )  # fmt: skip
    elif body.mass > 1e-6 and density < LIGHT and is_real:
        yield LintFinding(
            "mass", "warning", body.name,
            f"{body.mass:.4g} kg in a box of {extent.volume:.2g} m^3 is lighter than foam",
            "masses are in kg; a frame without mass is welded, not jointed",
        )  # fmt: skip


def missing_mass(model: LintInput) -> Iterator[LintFinding]:
    """Moving links without mass or without inertia, which the reader completes."""
    for word, what in (("massless", "mass"), ("point mass", "moments of inertia")):
        # Repairs quote the name of their link.
        found = [repair.partition("'")[2] for repair in model.robot.repairs if word in repair]
        names = [rest.partition("'")[0] for rest in found]
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
    joints = (joint for joint in model.root.findall("joint") if joint.get("type") != "fixed")
    children = chain.from_iterable(joint.findall("child") for joint in joints)
    moved = {child.get("link") for child in children}
    for link in model.root.findall("link"):
        is_shaped = link.find("visual") is not None or link.find("collision") is not None
        if link.get("name") in moved and is_shaped and link.find("inertial") is None:
            yield str(link.get("name"))


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
        # The box of a floating body is unknown, and a point mass has no moments of its own.
        floats = (model.robot.mj.jnt_type[model.robot.mj.jnt_bodyid == i + 1] == FREE).any()
        repaired = any(f"{body.name!r} given the inertia" in text for text in model.robot.repairs)
        if not floats and not repaired and body.inertia.any():
            yield from _size(body, extent)
            yield from _direction(model, i, body)


def _bodies_with_mass(model: LintInput) -> Iterator[tuple[int, BodyMass, BodyExtents]]:
    """Yield the index, mass and box of each moving body that has a mass and a shape."""
    for i in model.moving:
        body = model.bodies[i]
        extent = model.extents.get(body.name)
        if extent is not None and body.mass > 1e-6:
            yield i, body, extent


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
    # A rod has next to no moment along itself: the larger one there comes from exchanged numbers.
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


NEARLY: Final = (1e-5, 0.02)
"""rad; angle between axes that are meant to be parallel or at right angles, and are not."""


def limits(model: LintInput) -> Iterator[LintFinding]:
    """Limits that are zero or not there: excitation then takes usual ones."""
    moving = [joint.name for joint in model.robot.joints if joint.kind in ("hinge", "slide")]
    yield from _zero_limits(model, moving, "effort", "torque")
    yield from _zero_limits(model, moving, "velocity", "velocity")
    mj = model.robot.mj
    scalar = np.isin(mj.jnt_type, (HINGE, SLIDE))
    equal = np.isclose(mj.jnt_range[:, 0], mj.jnt_range[:, 1])
    without = scalar & ((mj.jnt_limited == 0) | equal)
    unlimited = [model.robot.joints[j].name for j in np.flatnonzero(without)]
    if unlimited:
        yield LintFinding(
            "limits", "note", unlimited[0],
            f"{len(unlimited)} of {len(moving)} joints have no position limit",
            "give limits, here or in [limits] of robot.toml; motions are designed within them",
        )  # fmt: skip


def _zero_limits(
    model: LintInput, moving: Sequence[str], key: str, what: str
) -> Iterator[LintFinding]:
    """Limits of one key that are written as zero."""
    written = {joint.get("name"): joint.find("limit") for joint in model.root.findall("joint")}
    zero = [name for name in moving if _is_zero(written.get(name), key)]
    if zero:
        number = count_text(len(zero), "joint")
        yield LintFinding(
            "limits", "warning", zero[0],
            f'{key}="0" of {number} is read as no limit',
            f"write the {what} limits of the drives",
        )  # fmt: skip


def _is_zero(limit: ET.Element | None, key: str) -> bool:
    """True for a written number that is zero."""
    try:
        return limit is not None and float(limit.get(key, "nan")) == 0.0
    except ValueError:
        return False


def drive_inertia(model: LintInput) -> Iterator[LintFinding]:
    """Rotor inertia that is absent, or one number for all drives."""
    dofs = [joint.vadr for joint in model.robot.joints if joint.kind == "hinge"]
    armature = model.robot.joint_terms.armature[dofs]
    if len(armature) < 2:
        return
    if not armature.any():
        yield LintFinding(
            "rotor-inertia", "note", "", "no joint has a rotor inertia",
            "geared drives need it: armature (MJCF), or [joints] armature in robot.toml",
        )  # fmt: skip
    elif len(armature) > 3 and np.ptp(armature) == 0.0:
        yield LintFinding(
            "rotor-inertia", "note", "", f"all joints have the rotor inertia {armature[0]:.3g}",
            "drives of different size have different ones",
        )  # fmt: skip


def axes(model: LintInput) -> Iterator[LintFinding]:
    """Axes of neighbouring joints that are parallel or at right angles but for rounding: base
    parameters then depend on each other nearly, not exactly."""
    for link in model.robot.tree.links:
        angle = _deviation(model, link)
        if NEARLY[0] < angle < NEARLY[1]:
            name = model.robot.body_names[link.body]
            yield LintFinding(
                "axes", "note", name,
                f"its axis is {angle:.1e} rad off parallel or perpendicular to the one before",
                "write angles with all digits (1.5707963267948966), so that base parameters "
                "combine exactly",
            )  # fmt: skip


def _deviation(model: LintInput, link: Link) -> float:
    """Angle (rad) by which the axis of a link and the one before are off parallel or perpendicular;
    0 where either has none, or several."""
    if link.parent < 0:
        return 0.0
    before, own = _only_axis(model.robot.tree.links[link.parent]), _only_axis(link)
    if before is None or own is None:
        return 0.0
    cosine = min(abs(float(before @ link.R0 @ own)), 1.0)
    return float(min(np.arccos(cosine), np.arcsin(cosine)))


def _only_axis(link: Link) -> Array | None:
    """Axis (3,) of the joint of a link, if it has one joint, with an axis."""
    joints = link.joints
    return joints[0].axis if len(joints) == 1 and joints[0].kind in (HINGE, SLIDE) else None


SAME: Final = 0.01
"""Relative difference of masses and moments that are meant to be equal."""

_SIDES: Final = (
    (r"left", "right"), (r"Left", "Right"), (r"LEFT", "RIGHT"),
    (r"(?<![A-Za-z])l(?=_)", "r"), (r"(?<=_)l(?![A-Za-z])", "r"),
    (r"(?<![A-Za-z])L(?=_)", "R"), (r"(?<=_)L(?![A-Za-z])", "R"),
    (r"(?<![A-Za-z])FL(?![A-Za-z])", "FR"), (r"(?<![A-Za-z])RL(?![A-Za-z])", "RR"),
    (r"(?<![A-Za-z])LF(?![A-Za-z])", "RF"), (r"(?<![A-Za-z])LH(?![A-Za-z])", "RH"),
)  # fmt: skip


def limbs(model: LintInput) -> Iterator[LintFinding]:
    """Bodies whose mass, moments or distance of the centre of mass differ from the other side's."""
    bodies = {body.name: body for body in model.bodies}
    for body in model.bodies:
        mirrored = (re.sub(left, right, body.name) for left, right in _SIDES)
        others = (bodies[name] for name in mirrored if name != body.name and name in bodies)
        other = next(others, None)
        if other is None or max(body.mass, other.mass) < 1e-3:
            continue
        if differing := _difference(body, other) or _reflection(model, body, other):
            yield LintFinding(
                "limbs", "warning", body.name, differing,
                "the two sides of a robot are mirror images; look which one is right",
            )  # fmt: skip


def _difference(body: BodyMass, other: BodyMass) -> str:
    """Differences of a pair, in words; "" for nothing."""
    if abs(body.mass - other.mass) > SAME * max(body.mass, other.mass):
        return f"it weighs {body.mass:.4g} kg, {other.name} {other.mass:.4g} kg"
    size = max(body.gyration, other.gyration)
    reach = [float(np.linalg.norm(one.com)) for one in (body, other)]
    if abs(reach[0] - reach[1]) > 0.1 * size + 1e-3:
        return (
            f"its centre of mass is {reach[0]:.3g} m from its frame, that of {other.name} "
            f"{reach[1]:.3g} m"
        )
    moments = [np.linalg.eigvalsh(one.inertia) for one in (body, other)]
    if np.abs(moments[0] - moments[1]).max() > 5 * SAME * max(moments[0][2], moments[1][2]):
        return f"its principal moments are not those of {other.name}"
    return ""


def _reflection(model: LintInput, body: BodyMass, other: BodyMass) -> str:
    """Centre of mass that is not the mirror image of the other side's, though the frames are."""
    names = model.robot.body_names
    pose, other_pose = (_pose(model, names.index(one.name) + 1) for one in (body, other))
    centre, other_centre = pose[:3, :3] @ body.com, other_pose[:3, :3] @ other.com
    origin, other_origin = pose[:3, 3], other_pose[:3, 3]
    for axis in np.flatnonzero(np.abs(origin) >= 1e-3):
        mirror = np.ones(3)
        mirror[axis] = -1.0
        # Only where the plane reflects one origin to the other.
        if np.linalg.norm(other_origin - mirror * origin) >= 1e-3:
            continue
        apart = float(np.linalg.norm(other_centre - mirror * centre))
        if apart > 0.1 * max(body.gyration, other.gyration) + 2e-3:
            return f"its centre of mass is {apart:.2g} m off the mirror image of {other.name}"
    return ""


def _pose(model: LintInput, body: int) -> Array:
    """Pose (4, 4) of a body in the world at the reference position."""
    mj, pose = model.robot.mj, np.eye(4)
    while body > 0:
        step = np.eye(4)
        step[:3, :3] = matrix_of_quaternion(mj.body_quat[body])
        step[:3, 3] = mj.body_pos[body]
        pose, body = step @ pose, int(mj.body_parentid[body])
    return pose


ROUNDED: Final = 1e-3
"""Share of the largest moment by which printed digits may break the triangle inequality."""

GROSS: Final = 0.1
"""Share of a joint's inertia from which on its change by the repair is an error: less is within
what the masses of a model are known to."""

SEEN: Final = 0.005
"""The same from which on it is printed."""

ZERO: Final = 1e-12
"""kg m^2; smaller moments are zeros that were computed, and the link is a point mass."""


def written_inertia(model: LintInput) -> Iterator[LintFinding]:
    """Inertias with a negative moment, or with one moment larger than the sum of the others: an
    error where the engines, which repair or take them, differ in what a joint feels."""
    for link in model.root.findall("link"):
        inertial = link.find("inertial")
        inertia = None if inertial is None else inertial.find("inertia")
        if inertial is None or inertia is None:
            continue
        name = str(link.get("name"))
        with suppress(ValueError, TypeError):  # the reader has its own words for such numbers
            six = element_inertia(inertia)
            if np.abs(six).max() > ZERO and not is_feasible(six, inertial):
                effect = _effect(model, name, inertial, six)
                moments = np.linalg.eigvalsh(inertia_matrix(six))
                excess = (
                    max(moments[2] - moments[0] - moments[1], -moments[0]) / np.abs(moments).max()
                )
                shown = ", ".join(f"{moment:.4g}" for moment in moments)
                felt = f"; its repair changes the inertia of a joint by {effect:.0%}"
                yield LintFinding(
                    rule="impossible-inertia",
                    severity="error" if effect > GROSS else "warning",
                    element=name,
                    message=f"no body has the principal moments {shown} kg m^2"
                    + (" (by rounding)" if excess <= ROUNDED else felt if effect > SEEN else ""),
                    advice="moments are positive, and none exceeds the sum of the others",
                )


def _effect(model: LintInput, name: str, inertial: ET.Element, six: Array) -> float:
    """Largest change of a joint's inertia by the repair of a link, over that inertia, at the
    reference position."""
    if name not in model.robot.body_names:
        return 0.0
    written, origin = inertia_matrix(six), inertial.find("origin")
    rpy = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
    R = matrix_of_quaternion(urdf_quaternion(np.array(rpy.split(), float)))
    axes = R.T @ model.joint_axes(model.robot.body_names.index(name) + 1)
    change = np.einsum("ij,ik,kj->j", axes, nearest_feasible(written) - written, axes)
    return float(np.abs(change / model.joint_inertia).max(initial=0.0))
