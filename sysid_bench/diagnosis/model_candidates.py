"""Candidates that change the model: the direction of gravity, and another robot of the library."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np

from sysid_bench.diagnosis.diagnose_input import GRAVITY, DiagnoseInput, terms
from sysid_bench.diagnosis.finding import NOTE
from sysid_bench.diagnosis.hypothesis import NORMAL, Candidate, Hypothesis, first_hypothesis
from sysid_bench.errors import SysidBenchError
from sysid_bench.evaluation.intervals import level_text
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest, read_manifest
from sysid_bench.models.robot import RobotModel
from sysid_bench.package_folders import package_folder, robots
from sysid_bench.types import Array, Recording

ANGLE: Final = 10.0
"""Degrees; below it the base may simply not be level."""

LINK: Final = "link"
UNSURE: Final = 10.0
"""Factor on the spreads of a link of which the model file says nothing."""


def gravity_direction(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with gravity along each axis of the base, and along the fitted vector."""
    e = before.evidence
    declared = e.robot.tree.gravity
    size = float(np.linalg.norm(declared)) or GRAVITY
    at_rest = replace(before.motion, v=0 * before.motion.v, a=0 * before.motion.a)
    inertial = e.regressor(before.motion) - e.regressor(at_rest)
    # Link columns are linear in gravity: those of three unit vectors give all of them.
    mounted = [replace(e.robot, tree=replace(e.robot.tree, gravity=g)) for g in np.eye(3)]
    axes = np.stack([e.regressor(at_rest, robot) for robot in mounted])
    fitted = _fitted_gravity(before, inertial, axes)
    norm = float(np.linalg.norm(fitted)) or 1.0
    for g in [*np.eye(3) * size, *-np.eye(3) * size, fitted * size / norm]:
        angle = _angle(g, declared)

        def turned(by: float, g: Array = g, angle: float = angle) -> Hypothesis:
            across = g - declared * (g @ declared) / max(float(declared @ declared), 1e-9)
            across *= size / max(float(np.linalg.norm(across)), 1e-9)
            there = declared * np.cos(np.radians(by)) + across * np.sin(np.radians(by))
            there = g if by == angle else there  # towards g and beyond
            return before.with_gravity(inertial + np.tensordot(there, axes, axes=1))

        if angle > ANGLE:
            yield Candidate(
                "gravity", tuple(range(e.count)), turned(angle),
                f"gravity fits {_text(fitted)} m/s^2 in the base frame, "
                f"{_angle(fitted, declared):.0f} degrees from the declared {_text(declared)}",
                f"{_gravity_edit(e.robot.manifest, g)}, or turn the base in the model",
                "links without inertias, and motions in which gravity does little",
                estimate=f"{angle:.0f} degrees", along=(angle, 3.0, turned),
            )  # fmt: skip


def _gravity_edit(manifest: Manifest, g: Array) -> str:
    """Edit of the model's name on the command line, and of the user's own robot.toml."""
    words = ",".join(f"{x:.4g}" for x in np.round(g, 2) + 0.0)
    own, name = manifest.manifest_file, manifest.path.name
    if own is not None:
        kind = next(
            (k for k in ("robots", "datasets") if own.is_relative_to(package_folder(k))), ""
        )
        if not kind:
            return f"gravity = {_text(g)} in {own.name}, or its name with ?gravity={words}"
        name = f"{'dataset:' * (kind == 'datasets')}{manifest.name}"
    return f"name the model '{name}?gravity={words}'"


def _fitted_gravity(before: Hypothesis, inertial: Array, axes: Array) -> Array:
    """Gravity (3,) by least squares, with the file's inertias, friction, armature and offset.

    `inertial` (N, n, p): link columns without gravity; `axes` (3, N, n, p): those of unit gravity.
    """
    e, theta = before.evidence, before.evidence.file_parameters.ravel()
    F, tau, columns = terms(before.motion), before.torque - inertial @ theta, axes @ theta
    lhs, rhs = [], []
    for j in range(e.count):
        size = float(np.sqrt((before.torque[:, j] ** 2).mean())) or 1.0
        # Friction, armature and offset are those of the joint; gravity is common to all.
        own = np.zeros((len(F), e.count, F.shape[2]))
        own[:, j] = F[:, j]
        lhs.append(np.column_stack([columns[:, :, j].T, own.reshape(len(F), -1)]) / size)
        rhs.append(tau[:, j] / size)
    found = np.linalg.lstsq(np.concatenate(lhs), np.concatenate(rhs), rcond=1e-9)[0]
    return np.asarray(found[:3])


def _angle(one: Array, other: Array) -> float:
    """Angle (degrees) between two vectors."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / size, -1, 1)))) if size else 180.0


def _text(g: Array) -> str:
    return "[" + ", ".join(f"{x:.3g}" for x in np.round(g, 2) + 0.0) + "]"


def link_inertia(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with a link whose mass, centre and inertia are almost unknown: the model
    file, not the recording, is wrong."""
    e, W = before.evidence, before.evidence.regressor(before.motion)
    for k, (name, phi) in enumerate(zip(e.link_names, e.file_parameters, strict=False)):
        own = slice(10 * k, 10 * k + 10)
        spread = np.ones(len(e.link_std))
        spread[own] = UNSURE
        freed = replace(before, given=e.normal(before.motion, W, spread=spread))
        found = freed.fit.links[own]
        if not found[0] > 0:
            continue
        left = freed.model.variances(freed.mixing)[own]
        half = NORMAL * e.link_std[10 * k] * UNSURE * float(np.sqrt(left[0]))
        interval = max(float(found[0]) - half, 0.0), float(found[0]) + half
        # A wider prior is believed less, by the logarithm of its width for each number known.
        yield Candidate(
            LINK, tuple(range(e.count)), freed,
            f"{name} has another mass or another centre of mass than in the model file: "
            f"{found[0]:.3g} kg ({level_text()} in [{interval[0]:.3g}, {interval[1]:.3g}]) at "
            f"{_text(found[1:4] / found[0])} m, not {phi[0]:.3g} kg at "
            f"{_text(phi[1:4] / max(phi[0], 1e-9))} m",
            "correct the link in the model file; recordings of it can be used as they are",
            "mistakes of the joint that carries the link look alike", most=NOTE,
            estimate=f"{found[0]:.3g} kg", interval=interval,
            unknowns=float(np.log(UNSURE) * (1.0 - left).sum()),
        )  # fmt: skip


def other_robot(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates with each robot of the library that has as many joints, in their order."""
    e = before.evidence
    for name, robot in _library():
        kinds = tuple(joint.kind for joint in robot.joints)
        # Gravity is that of the model that is judged: it is stated, and no property of a robot.
        robot = replace(robot, tree=replace(robot.tree, gravity=e.robot.tree.gravity))
        if robot.name == e.robot.name or kinds != e.kinds or robot.coupling is not None:
            continue
        yield Candidate(
            "robot", tuple(range(e.count)), first_hypothesis(_of_robot(e, robot)),
            f"the recording fits {robot.manifest.title or name} better than the model",
            f"--model {name}", "robots that are not in the library, and scaled twins",
        )  # fmt: skip


@cache
def _library() -> list[tuple[str, RobotModel]]:
    """Robots of the library that can be loaded, by name; they take longer than their fits."""
    found = []
    for name, file in robots().items():
        with suppress(SysidBenchError, OSError):
            found.append((name, load_robot(read_manifest(file))))
    return found


def _of_robot(evidence: DiagnoseInput, robot: RobotModel) -> DiagnoseInput:
    """The recording taken as that of another robot, joint by joint."""
    log, recording = evidence.log, evidence.log.recording
    q = np.tile(robot.mj.qpos0, (len(recording), 1))
    q[:, [joint.qadr for joint in robot.joints]] = recording.q[:, evidence.position_columns]
    tau = np.zeros((len(recording), len(robot.torque_rows)))
    tau[:] = evidence.torque_samples
    other = Recording(recording.t, q, tau, recording.rate, robot.torque_rows)
    # Edits look for the joints by name in the description, which is then one of that robot.
    name_of = dict(zip(evidence.joints, robot.rows, strict=True))
    renamed = tuple(name_of.get(joint, joint) for joint in log.description.joints)
    description = replace(log.description, joints=renamed)
    log = replace(log, description=description, recording=other, joints=robot.rows)
    return DiagnoseInput(log, robot)
