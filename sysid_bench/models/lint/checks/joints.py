"""Limits, axes and rotor inertias of joints."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from sysid_bench.errors import count_text
from sysid_bench.models.lint.finding import LintFinding
from sysid_bench.models.lint.lint_input import LintInput
from sysid_bench.models.tree import HINGE, SLIDE, Link
from sysid_bench.types import Array

NEARLY: Final = (1e-5, 0.02)
"""rad; angle between axes that are meant to be parallel or at right angles, and are not."""


def limits(model: LintInput) -> Iterator[LintFinding]:
    """Limits that are zero or not there: excitation then takes usual ones."""
    moving = [joint.name for joint in model.robot.joints if joint.kind in ("hinge", "slide")]
    yield from _zero_limits(model, moving, "effort", "torque")
    yield from _zero_limits(model, moving, "velocity", "velocity")
    unlimited = _unlimited(model)
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


def _unlimited(model: LintInput) -> list[str]:
    mj = model.robot.mj
    scalar = np.isin(mj.jnt_type, (HINGE, SLIDE))
    equal = np.isclose(mj.jnt_range[:, 0], mj.jnt_range[:, 1])
    without = scalar & ((mj.jnt_limited == 0) | equal)
    return [model.robot.joints[j].name for j in np.flatnonzero(without)]


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
