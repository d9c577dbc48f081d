"""Logs of a robot: joints that they do not move, preprocessing, and the payload."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import PAYLOADS, Payload, parse_payload
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_description import NO_JOINT, LogDescription
from sysid_bench.signals.pipeline_choice import PLAIN
from sysid_bench.signals.processing import Processing
from sysid_bench.signals.row_processing import Pipeline, ProcessedSignals, RowProcessing
from sysid_bench.types import Recording, Trajectory


@dataclass(frozen=True)
class LogProcessing:
    """Settings for all logs: `pipeline` gives motion, torque and rows of training logs. Motion and
    torque of test logs are those of `processing`, whatever the pipeline, so that
    pipelines are compared on the same rows. Rows whose joint moves slower than `moving` (rad/s,
    m/s) are left out of both: no model has static friction."""

    processing: Processing
    pipeline: Pipeline | None = None  # None: `processing`
    moving: float = 0.0
    filter: str = ""  # as written
    derivatives: str = ""
    name: str = PLAIN  # of the pipeline

    def signals(
        self, recording: Recording, joints: tuple[Joint, ...], training: bool
    ) -> ProcessedSignals:
        """Motion, torque and row processing of a recording for the fit or for a test."""
        if training and self.pipeline is not None:
            return self.pipeline.process(recording, joints)
        return ProcessedSignals(self.processing.apply(recording, joints))


@dataclass(frozen=True, eq=False)
class ProcessedLog:
    """A log after preprocessing, with the robot and its payload."""

    log: Log
    robot: RobotModel
    recording: Recording
    motors: Trajectory | None = None  # (N, k) each, where the log states a transmission
    rows: RowProcessing = field(default_factory=RowProcessing)  # of W beta = b

    @property
    def payload(self) -> Payload:
        """The payload that was mounted."""
        return self.robot.payload


def process_log(
    log: LogDescription, manifest: Manifest, preprocessing: LogProcessing, training: bool = True
) -> ProcessedLog:
    """Read and preprocess a log for the fit or for a test; its contradictions are still to be
    refused.

    Raises UsageError for a file or a filter that cannot be used.
    """
    robot = load_robot(manifest, payload_of(log))
    read = read_log(log, robot)
    try:
        processed = preprocessing.signals(read.recording, robot.joints, training)
    except UsageError as error:
        raise UsageError(f"{log.source}: {error}") from error
    # Dependent joints follow from the filtered independent ones: the closure is nonlinear.
    motion = robot.completed(processed.recording.motion)
    recording = replace(processed.recording, q=motion.q, v=motion.v, a=motion.a)
    motors = None
    if read.coordinates is not None and log.transmission is not None:
        # Motors are filtered like joints. q = G q_motor, and G is constant: rates transform alike.
        joints = tuple(Joint(name, "hinge", k, k, (name,)) for k, name in enumerate(log.joints))
        moved = preprocessing.signals(read.coordinates, joints, training).recording.motion
        q, v, a = np.linalg.solve(
            log.transmission, np.stack([moved.q.T, moved.v.T, moved.a.T])
        ).swapaxes(1, 2)
        motors = replace(moved, q=q, v=v, a=a)
    return ProcessedLog(read, robot, recording, motors, processed.rows)


def payload_of(log: LogDescription) -> Payload:
    """The payload that a log states, a name, { use = name } or a table; none where it states
    none."""
    written = log.payload
    if written is None:
        return PAYLOADS["none"]
    if isinstance(written, Mapping) and set(written) == {"use"}:
        return parse_payload(written["use"])
    return parse_payload(written)


SCALAR: Final = ("hinge", "slide")
"""Kinds of joints with one coordinate, which logs can record."""


def lock_manifest(
    manifest: Manifest, robot: RobotModel, logs: Sequence[LogDescription], takes_base: bool = False
) -> Manifest:
    """The manifest with those joints locked that the logs do not list and that depend on none of
    the listed ones. With `takes_base`, a base whose motion is recorded stays free.

    Raises UsageError where the logs differ in their joints or in the positions of locked ones, and
    for the motion of a base that would not be used.
    """
    first = logs[0]
    recorded = set(first.joints) - {NO_JOINT}
    scalar = {joint.dofs[0] for joint in robot.joints if joint.kind in SCALAR}
    unknown = [name for name in first.joints if name not in {*scalar, NO_JOINT}]
    if unknown:
        advice = f"Write {NO_JOINT!r} for a coordinate that is not a joint of the model."
        raise UsageError(f"{first.source}: {unknown_name('joint', unknown[0], scalar, advice)}")
    for log in logs:
        _check_alike(log, first, takes_base)
    moving = recorded | _followers(robot, recorded, first)
    return replace(manifest, locked={**manifest.locked, **_still_joints(robot, moving, first)})


def _still_joints(robot: RobotModel, moving: set[str], log: LogDescription) -> dict[str, float]:
    """The positions of the joints that stand still, those that the log states among them; raises
    UsageError where it states one that moves."""
    still = {
        # A hinge or slide rests where the zero configuration of the model has it; other kinds are
        # locked in their frame.
        joint.name: float(robot.mj.qpos0[joint.qadr]) if joint.kind in SCALAR else 0.0
        for joint in robot.joints
        if moving.isdisjoint(joint.dofs) and not (joint.kind == "free" and log.base is not None)
    }
    stated = log.locked or {}
    for name in stated:
        if name not in still:
            known = ", ".join(still) or "none"
            raise UsageError(
                f"{log.source}: locked names {name!r}, which is recorded or does not exist; "
                f"joints that stand still are: {known}."
            )
    return {**still, **stated}


def _check_alike(log: LogDescription, first: LogDescription, takes_base: bool) -> None:
    """Raise UsageError for a log with other joints or locked ones than the first, for the motion of
    a base that is not used, and for one that is not in all logs."""
    if set(log.joints) - {NO_JOINT} != set(first.joints) - {NO_JOINT}:
        raise UsageError(
            f"{log.source} lists other joints than {first.source}; logs that are used together "
            "have to move the same ones."
        )
    if dict(log.locked or {}) != dict(first.locked or {}):
        raise UsageError(
            f"{log.source} locks joints elsewhere than {first.source}; identify them apart."
        )
    if log.base is not None and not takes_base:
        raise UsageError(
            f"{log.source}: the recorded motion of a base is used by `identify --task actuators` "
            "alone; here the base is held, so leave base out if it was."
        )
    if (log.base is None) != (first.base is None):
        raise UsageError(
            f"{log.source} and {first.source} differ in base; logs that are used together all have "
            "the motion of the base, or none."
        )


def _followers(robot: RobotModel, recorded: set[str], log: LogDescription) -> set[str]:
    """The joints that follow the recorded ones; UsageError for a recorded one that follows others.

    A dependent joint moves with any of its drivers, as in a closed chain.
    """
    if robot.coupling is None:
        return set()
    drivers = {
        robot.rows[dof]: [robot.rows[driver] for driver in robot.coupling.independent_of(dof)]
        for dof in robot.coupling.dependent.tolist()
    }
    wrong = sorted(recorded.intersection(drivers))
    if wrong:
        raise UsageError(
            f"{log.source}: joint {wrong[0]!r} follows {', '.join(drivers[wrong[0]])}; list that "
            "one in its place, or choose the joints that move in a manifest: [coupling] "
            "independent = [...]."
        )
    return {name for name, names in drivers.items() if not recorded.isdisjoint(names)}
