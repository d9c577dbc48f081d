"""Direction of gravity in the base frame: the fitted vector against the declared one."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import terms
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array

ANGLE: Final = 10.0
"""Degrees; below it the base may simply not be level."""
BLIND: Final = "links without inertias, and motions in which gravity does little"
STANDARD: Final = 9.81


def gravity_direction(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with gravity along each axis of the base, and along the fitted vector."""
    e = before.evidence
    declared = e.robot.tree.gravity
    size = float(np.linalg.norm(declared)) or STANDARD
    at_rest = replace(before.motion, v=0 * before.motion.v, a=0 * before.motion.a)
    inertial = e.regressor(before.motion) - e.regressor(at_rest)
    axes = np.stack([e.regressor(at_rest, _in_gravity(e.robot, g)) for g in np.eye(3)])
    fitted = _fitted_gravity(before, inertial, axes)
    norm = float(np.linalg.norm(fitted)) or 1.0
    for g in [*np.eye(3) * size, *-np.eye(3) * size, fitted * size / norm]:
        if _angle(g, declared) > ANGLE:
            columns = inertial + np.tensordot(g, axes, axes=1)
            yield _cure(before, columns, g, fitted)


def _cure(before: Hypothesis, columns: Array, g: Array, fitted: Array) -> Candidate:
    declared = before.evidence.robot.tree.gravity
    return Candidate(
        name="gravity",
        joints=tuple(range(before.evidence.count)),
        hypothesis=before.with_columns(columns),
        message=(
            f"gravity fits {_text(fitted)} m/s^2 in the base frame, {_angle(fitted, declared):.0f} "
            f"degrees from the declared {_text(declared)}"
        ),
        edit=f"gravity = {_text(g)} in the robot's manifest, or turn the base in the model",
        blind=BLIND,
    )


def _fitted_gravity(before: Hypothesis, inertial: Array, axes: Array) -> Array:
    """Gravity (3,) by least squares, with the file's inertias, friction, armature and offset.

    `inertial` (N, n, p): link columns without gravity; `axes` (3, N, n, p): those of unit gravity.
    """
    e, theta = before.evidence, before.evidence.file_parameters.ravel()
    F, tau, columns = terms(before.motion), before.torque - inertial @ theta, axes @ theta
    lhs, rhs = [], []
    for j in range(e.count):
        size = float(np.sqrt((before.torque[:, j] ** 2).mean())) or 1.0
        own = np.zeros((len(F), e.count, F.shape[2]))
        own[:, j] = F[:, j]
        lhs.append(np.column_stack([columns[:, :, j].T, own.reshape(len(F), -1)]) / size)
        rhs.append(tau[:, j] / size)
    found = np.linalg.lstsq(np.concatenate(lhs), np.concatenate(rhs), rcond=1e-9)[0]
    return np.asarray(found[:3])


def _in_gravity(robot: RobotModel, gravity: Array) -> RobotModel:
    return replace(robot, tree=replace(robot.tree, gravity=gravity))


def _angle(one: Array, other: Array) -> float:
    """Angle (degrees) between two vectors."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / size, -1, 1)))) if size else 180.0


def _text(g: Array) -> str:
    return "[" + ", ".join(f"{x:.3g}" for x in np.round(g, 2) + 0.0) + "]"
