"""Left and right limbs that differ."""

import re
from collections.abc import Iterator
from typing import Final

import numpy as np

from sysid_bench.models.lint.finding import LintFinding
from sysid_bench.models.lint.lint_input import BodyMass, LintInput
from sysid_bench.spatial import matrix_of_quaternion
from sysid_bench.types import Array

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
        other = next((bodies[n] for n in _other_sides(body.name) if n in bodies), None)
        if other is not None and (differing := _pair_difference(model, body, other)):
            yield LintFinding(
                "limbs", "warning", body.name, differing,
                "the two sides of a robot are mirror images; look which one is right",
            )  # fmt: skip


def _pair_difference(model: LintInput, body: BodyMass, other: BodyMass) -> str:
    """Differences of a pair, in words; "" for nothing, and for a pair without mass."""
    if max(body.mass, other.mass) < 1e-3:
        return ""
    return _difference(body, other) or _reflection(model, body, other)


def _other_sides(name: str) -> Iterator[str]:
    for left, right in _SIDES:
        other = re.sub(left, right, name)
        if other != name:
            yield other


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
    for mirror in _mirrors(pose[:3, 3], other_pose[:3, 3]):
        apart = float(np.linalg.norm(other_centre - mirror * centre))
        if apart > 0.1 * max(body.gyration, other.gyration) + 2e-3:
            return f"its centre of mass is {apart:.2g} m off the mirror image of {other.name}"
    return ""


def _mirrors(origin: Array, other: Array) -> Iterator[Array]:
    """Yield the signs (3,) of each reflection of one origin (3,) to the other."""
    for axis in np.flatnonzero(np.abs(origin) >= 1e-3):
        mirror = np.ones(3)
        mirror[axis] = -1.0
        if np.linalg.norm(other - mirror * origin) < 1e-3:
            yield mirror


def _pose(model: LintInput, body: int) -> Array:
    """Pose (4, 4) of a body in the world at the reference position."""
    mj, pose = model.robot.mj, np.eye(4)
    while body > 0:
        step = np.eye(4)
        step[:3, :3] = matrix_of_quaternion(mj.body_quat[body])
        step[:3, 3] = mj.body_pos[body]
        pose, body = step @ pose, int(mj.body_parentid[body])
    return pose
