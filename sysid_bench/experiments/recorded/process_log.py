"""Preprocessing of logs: filtered motion and torque, with the robot and its payload."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import Manifest
from sysid_bench.models.payload import PAYLOADS, Payload, parse_payload
from sysid_bench.models.robot import Joint, RobotModel
from sysid_bench.signals.log import Log, read_log
from sysid_bench.signals.log_description import LogDescription
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
    return ProcessedLog(
        read,
        robot,
        replace(processed.recording, q=motion.q, v=motion.v, a=motion.a),
        _motors(read, preprocessing, training),
        processed.rows,
    )


def _motors(log: Log, preprocessing: LogProcessing, training: bool) -> Trajectory | None:
    """Motion of the motors, filtered like that of the joints."""
    if log.coordinates is None or log.description.transmission is None:
        return None
    joints = tuple(
        Joint(name, "hinge", k, k, (name,)) for k, name in enumerate(log.description.joints)
    )
    motion = preprocessing.signals(log.coordinates, joints, training).recording.motion
    # q = G q_motor, and G is constant: rates transform alike.
    q, v, a = np.linalg.solve(
        log.description.transmission, np.stack([motion.q.T, motion.v.T, motion.a.T])
    ).swapaxes(1, 2)
    return replace(motion, q=q, v=v, a=a)


def payload_of(log: LogDescription) -> Payload:
    """The payload that a log states, a name, { use = name } or a table; none where it states
    none."""
    written = log.payload
    if written is None:
        return PAYLOADS["none"]
    if isinstance(written, Mapping) and set(written) == {"use"}:
        return parse_payload(written["use"])
    return parse_payload(written)
