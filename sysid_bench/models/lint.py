"""Linter: mistakes in a model file as a model of dynamics.

A model is loaded as the product loads it; each rule then yields its findings.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Final, Literal

import mujoco
import numpy as np

from sysid_bench.errors import ModelError, StaticModelError, count_text, first_names, reason_of
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, find_manifest, read_manifest
from sysid_bench.models.model_checks import placeholder_reason
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.shape import body_extents
from sysid_bench.models.sources import model_files
from sysid_bench.models.tree import FREE, HINGE, SLIDE
from sysid_bench.models.urdf_links import element_inertia, is_feasible, nearest_feasible
from sysid_bench.models.xml_file import parse_xml, read_file
from sysid_bench.spatial import (
    body_mass_inertia,
    inertia_matrix,
    matrix_of_quaternion,
    urdf_quaternion,
)
from sysid_bench.types import Array, BodyExtents

Severity = Literal["error", "warning", "note"]
SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")


@dataclass(frozen=True)
class LintFinding:
    """Finding on an element of a model: `rule` names the check, `element` the body or joint
    ("" for the whole model), `advice` says what to do, `line` where it is in the file."""

    rule: str
    severity: Severity
    element: str
    message: str
    advice: str
    file: str = ""
    line: int | None = None

    @property
    def text(self) -> str:
        """file:line: severity rule: message; advice."""
        place = f"{self.file}:{self.line}" if self.line else self.file
        where = f"{self.element}: " if self.element else ""
        return f"{place}: {self.severity} {self.rule}: {where}{self.message}; {self.advice}"


@dataclass(frozen=True, eq=False)
class _Body:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2) of a body, in its frame; `extent`
    its generous bounding box, None where nothing is known of its shape."""

    name: str
    mass: float
    com: Array
    inertia: Array
    extent: BodyExtents | None

    @cached_property
    def gyration(self) -> float:
        """Largest radius of gyration (m)."""
        moments = np.linalg.eigvalsh(self.inertia)
        return float(np.sqrt(max(moments[2], 0.0) / self.mass)) if self.mass > 0 else 0.0


@dataclass(frozen=True, eq=False)
class _Model:
    """A model file: its root element, and the robot, repaired where that was needed."""

    root: ET.Element
    robot: RobotModel

    @cached_property
    def bodies(self) -> tuple[_Body, ...]:
        """Bodies of the robot in the order of `robot.body_names`."""
        extents, found = body_extents(self.robot), []
        for name, phi in zip(self.robot.body_names, self.robot.phi, strict=True):
            found.append(_Body(name, *body_mass_inertia(phi), extents.get(name)))
        return tuple(found)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Indices of the bodies that a joint moves, themselves or through a body above them."""
        return tuple(i for i, link in enumerate(self.robot.tree.carrier) if link >= 0)

    @property
    def settings(self) -> str:
        """File of the user that takes what a model file does not hold."""
        file = self.robot.manifest.manifest_file
        return "a robot.toml ('sysid-bench init robot')" if file is None else file.name

    @property
    def shaped(self) -> Iterator[tuple[int, _Body, BodyExtents]]:
        """Index, body and box of each moving body that has a mass and a shape."""
        for i in self.moving:
            body = self.bodies[i]
            if body.extent is not None and body.mass > 1e-6:
                yield i, body, body.extent


def lint_model(manifest: Manifest) -> list[LintFinding]:
    """Findings of a model, errors first, without those that its manifest suppresses.

    A model that cannot be loaded has one finding, its error.
    """
    file = str(manifest.path)
    try:
        robot = load_robot(manifest)
    except StaticModelError as error:
        advice = "leave it out where robots are checked"
        return [LintFinding("motionless", "note", "", str(error).rstrip("."), advice, file)]
    except Exception as error:  # one file never takes the others with it
        return [_not_loaded(error, file)]
    text = robot.text if manifest.text is not None else read_file(manifest.path)
    model = _Model(parse_xml(text, manifest.path.name), robot)
    placed = []
    for finding in chain.from_iterable(rule(model) for rule in RULES):
        # A manifest suppresses a rule, or a rule of one element ("mass:link3").
        names = {finding.rule, f"{finding.rule}:{finding.element}"}
        if names.isdisjoint(manifest.suppressed):
            name = rb"\bname\s*=\s*[\"']" + re.escape(finding.element.encode()) + rb"[\"']"
            tag = re.search(rb"<(?:link|joint|body)\b[^>]*?" + name, text)
            known = tag is not None and finding.element
            line = 1 + text.count(b"\n", 0, tag.start()) if tag is not None and known else None
            placed.append(replace(finding, file=file, line=line))
    return sorted(placed, key=lambda finding: SEVERITIES.index(finding.severity))


def find_model_files(folder: Path) -> tuple[list[Manifest], list[LintFinding]]:
    """Models below a folder, which may read any file in it: that of each robot.toml, then the model
    files that none of these names; and a finding for each robot.toml that cannot be read."""
    found: list[Manifest] = []
    broken: list[LintFinding] = []
    for file in sorted(folder.rglob("robot.toml")):
        try:
            found.append(read_manifest(file))
        except ModelError as error:
            broken.append(_not_loaded(error, str(file)))
    named = {manifest.path.resolve() for manifest in found}
    rest = [file for file in model_files(folder) if file.resolve() not in named]
    lone = (replace(find_manifest(f"file:{file}"), assets=folder) for file in rest)
    return [*found, *lone], broken


def _not_loaded(error: Exception, file: str) -> LintFinding:
    advice = "try the corrected file with 'sysid-bench crosscheck'"
    return LintFinding("load", "error", "", reason_of(error).rstrip("."), advice, file)


ZERO: Final = 1e-12
"""kg m^2; smaller moments are zeros that were computed, and the link is a point mass."""
ROUNDED: Final = 1e-3
"""Share of the largest moment by which printed digits may break the triangle inequality."""
GROSS: Final = 0.1
"""Share of a joint's inertia from which on its change by the repair is an error: less is within
what the masses of a model are known to."""


def _written_inertia(model: _Model) -> Iterator[LintFinding]:
    """Inertias with a negative moment, or with one moment larger than the sum of the others: an
    error where the engines, which repair or take them, differ in what a joint feels."""
    for link in model.root.findall("link"):
        inertial, inertia = link.find("inertial"), link.find("inertial[1]/inertia")
        if inertial is None or inertia is None:
            continue
        name = str(link.get("name"))
        with suppress(ValueError, TypeError):  # the reader has its own words for such numbers
            six = element_inertia(inertia)
            if np.abs(six).max() <= ZERO or is_feasible(six, inertial):
                continue
            effect = _repair_effect(model.robot, name, inertial, six)
            moments = np.linalg.eigvalsh(inertia_matrix(six))
            excess = max(moments[2] - moments[0] - moments[1], -moments[0]) / np.abs(moments).max()
            rest = f"; its repair changes the inertia of a joint by {effect:.0%}"
            if excess <= ROUNDED:
                rest = " (by rounding)"
            elif effect <= 0.005:
                rest = ""
            shown = ", ".join(f"{moment:.4g}" for moment in moments)
            yield LintFinding(
                "impossible-inertia", "error" if effect > GROSS else "warning", name,
                f"no body has the principal moments {shown} kg m^2{rest}",
                "moments are positive, and none exceeds the sum of the others",
            )  # fmt: skip


def _repair_effect(robot: RobotModel, name: str, inertial: ET.Element, six: Array) -> float:
    """Largest change of a joint's inertia by the repair of a link, over that inertia, at the
    reference position."""
    if name not in robot.body_names:
        return 0.0
    mj, body = robot.mj, robot.body_names.index(name) + 1  # MuJoCo counts the world
    data = mujoco.MjData(mj)
    mujoco.mj_forward(mj, data)
    M, rates = np.zeros((mj.nv, mj.nv)), np.zeros((3, mj.nv))
    mujoco.mj_fullM(mj, data, M)
    mujoco.mj_jacBody(mj, data, None, rates, body)
    written, origin = inertia_matrix(six), inertial.find("origin")
    rpy = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
    R = matrix_of_quaternion(urdf_quaternion(np.array(rpy.split(), float)))
    # Rates of rotation (3, nv) for unit rates of the joints, in the axes of the inertia.
    axes = R.T @ (data.xmat[body].reshape(3, 3).T @ rates)
    change = np.einsum("ij,ik,kj->j", axes, nearest_feasible(written) - written, axes)
    return float(np.abs(change / np.diag(M)).max(initial=0.0))


def _placeholder_inertia(model: _Model) -> Iterator[LintFinding]:
    """Inertias that stand for none: equal on all links, for a sphere of the whole robot."""
    if reason := placeholder_reason(model.robot):
        yield LintFinding(
            "placeholder-inertia", "warning", "", reason,
            "give every link its own mass and inertia; no prior is taken from these",
        )  # fmt: skip


STEEL: Final = 8000.0
"""kg/m^3; the box around a link has no higher mean density."""
TOO_DENSE: Final = 3.0
"""Densities above this many times that of steel are errors: gold has 2.4."""
LIGHT: Final = 1.0
"""kg/m^3; below it the mass of a link that carries a motor is in a wrong unit, or not there."""
HEAVY: Final = 2000.0
"""kg; sum of masses of a robot above which the sum is named."""


def _mass_size(model: _Model) -> Iterator[LintFinding]:
    """Masses that no link of that size has, and the sum of masses."""
    mj = model.robot.mj
    for i in model.moving:
        body = model.bodies[i]
        if body.extent is None:
            continue
        density = body.mass / body.extent.volume
        weight = f"{body.mass:.4g} kg in a box of {body.extent.volume:.2g} m^3"
        # With joints of its own and shapes a body is more than a frame of the file.
        is_real = mj.body_jntnum[i + 1] and mj.body_geomnum[i + 1]
        if density > STEEL:
            yield LintFinding(
                "mass", "error" if density > TOO_DENSE * STEEL else "warning", body.name,
                f"{weight} is denser than steel", "masses are in kg, lengths in m",
            )  # fmt: skip
        elif body.mass > 1e-6 and density < LIGHT and is_real:
            yield LintFinding(
                "mass", "warning", body.name, f"{weight} is lighter than foam",
                "masses are in kg; a frame without mass is welded, not jointed",
            )  # fmt: skip
    total = sum(model.bodies[i].mass for i in model.moving)
    if total > HEAVY:
        yield LintFinding(
            "sum-of-masses", "warning", "", f"the moving bodies weigh {total:.4g} kg",
            "masses are in kg",
        )  # fmt: skip


def _missing_mass(model: _Model) -> Iterator[LintFinding]:
    """Moving links without mass or without inertia, which the reader completes."""
    for word, what in (("massless", "mass"), ("point mass", "moments of inertia")):
        # Repairs quote the name of their link.
        found = [repair.partition("'")[2] for repair in model.robot.repairs if word in repair]
        names = [rest.partition("'")[0] for rest in found]
        if word == "massless":
            names = list(dict.fromkeys((*names, *_bare_links(model.root))))
        if names:
            yield LintFinding(
                "missing-mass", "warning", names[0],
                f"{len(names)} links have no {what}: {first_names(names)}",
                "give each its inertial, or weld it",
            )  # fmt: skip


def _bare_links(root: ET.Element) -> Iterator[str]:
    """Links of a URDF that a joint moves and that have a shape, but no inertial."""
    joints = [joint for joint in root.findall("joint") if joint.get("type") != "fixed"]
    moved = {child.get("link") for joint in joints for child in joint.findall("child")}
    for link in root.findall("link"):
        is_shaped = link.find("visual") is not None or link.find("collision") is not None
        if link.get("name") in moved and is_shaped and link.find("inertial") is None:
            yield str(link.get("name"))


def _mass_positions(model: _Model) -> Iterator[LintFinding]:
    """Centres of mass outside of their links."""
    for _, body, extent in model.shaped:
        outside = float(np.maximum(extent.low - body.com, body.com - extent.high).max())
        if outside > 0:
            yield LintFinding(
                "centre-of-mass", "warning", body.name,
                f"the centre of mass lies {outside:.2g} m outside of the link",
                "it is in m, in the frame of the link",
            )  # fmt: skip


WIDE: Final = 1.5
"""Radius of gyration over the half diagonal of the box from which on the moments are too large."""
NARROW: Final = 0.002
"""The same from which on they are too small."""
EXCHANGED: Final = 1.5
"""Ratio between the moments along and across a long link from which on they look exchanged."""


def _inertia_size(model: _Model) -> Iterator[LintFinding]:
    """Moments of inertia for another size or direction than that of the link."""
    mj = model.robot.mj
    for i, body, extent in model.shaped:
        # The box of a floating body is unknown, and a point mass has no moments of its own.
        floats = (mj.jnt_type[mj.jnt_bodyid == i + 1] == FREE).any()
        repaired = any(f"{body.name!r} given the inertia" in text for text in model.robot.repairs)
        if floats or repaired or not body.inertia.any():
            continue
        half = 0.5 * float(np.linalg.norm(extent.high - extent.low))
        ratio = body.gyration / half
        if ratio > WIDE or ratio < NARROW:
            kind = "large" if ratio > 1 else "small"
            yield LintFinding(
                "moments", "error" if ratio > 10 * WIDE else "warning", body.name,
                f"its radius of gyration is {body.gyration:.2g} m, too {kind} for a link within "
                f"{half:.2g} m",
                "moments are in kg m^2, about the centre of mass",
            )  # fmt: skip
        axis = _long_axis(model, i)
        if axis is None:
            continue
        # A rod has next to no moment along itself: the larger one there comes from exchanged
        # numbers.
        along = float(axis @ body.inertia @ axis)
        across = 0.5 * (float(np.trace(body.inertia)) - along)
        if along > EXCHANGED * across:
            yield LintFinding(
                "moments", "warning", body.name,
                f"the moment about its long axis, {along:.3g} kg m^2, is larger than across it, "
                f"{across:.3g}",
                "look whether moments are exchanged, or the axes of the inertia are others",
            )  # fmt: skip


def _long_axis(model: _Model, i: int) -> Array | None:
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


def _limits(model: _Model) -> Iterator[LintFinding]:
    """Limits that are zero or not there: excitation then takes usual ones."""
    moving = [joint.name for joint in model.robot.joints if joint.kind in ("hinge", "slide")]
    written = {joint.get("name"): joint.find("limit") for joint in model.root.findall("joint")}
    for key, what in (("effort", "torque"), ("velocity", "velocity")):
        zero = []
        for name in moving:
            limit = written.get(name)
            with suppress(ValueError):
                if limit is not None and float(limit.get(key, "nan")) == 0.0:
                    zero.append(name)
        if zero:
            yield LintFinding(
                "limits", "warning", zero[0],
                f'{key}="0" of {count_text(len(zero), "joint")} is read as no limit',
                f"write the {what} limits of the drives",
            )  # fmt: skip
    mj = model.robot.mj
    scalar = np.isin(mj.jnt_type, (HINGE, SLIDE))
    equal = np.isclose(mj.jnt_range[:, 0], mj.jnt_range[:, 1])
    without = np.flatnonzero(scalar & ((mj.jnt_limited == 0) | equal))
    if len(without):
        yield LintFinding(
            "limits", "note", model.robot.joints[without[0]].name,
            f"{len(without)} of {len(moving)} joints have no position limit",
            f"give limits in {model.robot.manifest.path.name}, or in [limits] of {model.settings}; "
            "motions are designed within them",
        )  # fmt: skip


def _drive_inertia(model: _Model) -> Iterator[LintFinding]:
    """Rotor inertia that is absent, or one number for all drives."""
    dofs = [joint.vadr for joint in model.robot.joints if joint.kind == "hinge"]
    armature = model.robot.joint_terms.armature[dofs]
    if len(armature) >= 2 and not armature.any():
        yield LintFinding(
            "rotor-inertia", "note", "", "no joint has a rotor inertia",
            f"geared drives need it: armature of an MJCF, or in [joints.all] of {model.settings}",
        )  # fmt: skip
    elif len(armature) > 3 and np.ptp(armature) == 0.0:
        yield LintFinding(
            "rotor-inertia", "note", "", f"all joints have the rotor inertia {armature[0]:.3g}",
            "drives of different size have different ones",
        )  # fmt: skip


def _axes(model: _Model) -> Iterator[LintFinding]:
    """Axes of neighbouring joints that are parallel or at right angles but for rounding: base
    parameters then depend on each other nearly, not exactly."""
    links = model.robot.tree.links
    for link in links:
        pair = (links[link.parent], link) if link.parent >= 0 else ()
        joints = [one.joints[0] for one in pair if len(one.joints) == 1]
        if len(joints) < 2 or not {joint.kind for joint in joints} <= {HINGE, SLIDE}:
            continue
        cosine = min(abs(float(joints[0].axis @ link.R0 @ joints[1].axis)), 1.0)
        angle = float(min(np.arccos(cosine), np.arcsin(cosine)))
        if 1e-5 < angle < 0.02:  # rad
            yield LintFinding(
                "axes", "note", model.robot.body_names[link.body],
                f"its axis is {angle:.1e} rad off parallel or perpendicular to the one before",
                "write angles with all digits (1.5707963267948966), so that base parameters "
                "combine exactly",
            )  # fmt: skip


SAME: Final = 0.01
"""Relative difference of masses and moments that are meant to be equal."""

_SIDES: Final = (
    (r"left", "right"), (r"Left", "Right"), (r"LEFT", "RIGHT"),
    (r"(?<![A-Za-z])l(?=_)", "r"), (r"(?<=_)l(?![A-Za-z])", "r"),
    (r"(?<![A-Za-z])L(?=_)", "R"), (r"(?<=_)L(?![A-Za-z])", "R"),
    (r"(?<![A-Za-z])FL(?![A-Za-z])", "FR"), (r"(?<![A-Za-z])RL(?![A-Za-z])", "RR"),
    (r"(?<![A-Za-z])LF(?![A-Za-z])", "RF"), (r"(?<![A-Za-z])LH(?![A-Za-z])", "RH"),
)  # fmt: skip


def _limbs(model: _Model) -> Iterator[LintFinding]:
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


def _difference(body: _Body, other: _Body) -> str:
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


def _reflection(model: _Model, body: _Body, other: _Body) -> str:
    """Centre of mass that is not the mirror image of the other side's, though the frames are."""
    mj, frames = model.robot.mj, []
    for one in (body, other):
        # Pose (4, 4) of the body in the world at the reference position.
        pose, b = np.eye(4), model.robot.body_names.index(one.name) + 1
        while b > 0:
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = matrix_of_quaternion(mj.body_quat[b]), mj.body_pos[b]
            pose, b = step @ pose, int(mj.body_parentid[b])
        frames.append((pose[:3, 3], pose[:3, :3] @ one.com))
    (origin, centre), (other_origin, other_centre) = frames
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


def _units(model: _Model) -> Iterator[LintFinding]:
    """Values that look like millimetres, degrees or g mm^2."""
    for repair in model.robot.repairs:
        if repair.endswith("?"):
            yield LintFinding("units", "warning", "", repair, "SI units: m, rad, kg, kg m^2")


RULES: Final[tuple[Callable[[_Model], Iterator[LintFinding]], ...]] = (
    _written_inertia, _placeholder_inertia, _mass_size, _missing_mass,
    _mass_positions, _inertia_size, _limits, _drive_inertia, _axes,
    _limbs, _units,
)  # fmt: skip
