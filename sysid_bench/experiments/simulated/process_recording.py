"""Preprocessing of simulated recordings: in-situ calibration of sensors, removal of contacts."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.simulated.built_plant import built_plant
from sysid_bench.experiments.simulated.measured_sensors import MeasuredSensors
from sysid_bench.experiments.simulated.problem import ProblemBuilder, measured_signals
from sysid_bench.experiments.simulated.record import SampledRecording, SimulatedRobot, record
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.identification.linear.least_squares import dense_rows
from sysid_bench.identification.wrench_sensor import Calibration, fit_calibration, free_samples
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.sensor import instruments_of, subtree_at
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.signals.filter import NoFilter
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.types import Array, Recording, Trajectory
from sysid_bench.units import interval


@dataclass(frozen=True, eq=False)
class ProcessedRecording:
    """A recording with its sensors calibrated: `raw` unfiltered, `recording` filtered. Contact
    periods were the share `left_out` of its samples. `rows` of W beta = b are still to be
    processed; a filter of rows cannot cross gaps, and contacts then stay in the recording: samples
    that are not `free` (N,) are without weight before the filter. None: all are free."""

    raw: Recording
    recording: Recording
    left_out: float
    rows: RowProcessing = field(default_factory=RowProcessing)
    free: Array | None = None

    @property
    def motion_without_contact(self) -> Trajectory:
        """The motion without contact periods."""
        motion = self.recording.motion
        return motion if self.free is None else _part(self.recording, self.free).motion


def process_recording(
    spec: ExperimentSpec, loaded: LoadedRobot, builder: ProblemBuilder, sampled: SampledRecording
) -> ProcessedRecording:
    """The recording as the task needs it.

    Raises UsageError where the contact periods leave nothing.
    """
    raw, recording = sampled.raw, sampled.recording
    if "calibration" in spec.signals and builder.task.cuts:
        calibration = _estimate_calibration(spec, loaded, builder.task)
        raw, recording = (_calibrated(one, calibration) for one in (raw, recording))
    contacts = spec.signals.get("contacts")
    if not contacts:
        return ProcessedRecording(raw, recording, 0.0, sampled.rows)
    free = _free_samples(contacts, recording, builder)
    if isinstance(sampled.rows.filter, NoFilter):
        kept = _part(recording, free)
        return ProcessedRecording(raw, kept, 1.0 - float(free.mean()), sampled.rows)
    free = _with_margin(free, sampled.margin)
    recording = replace(recording, period=None)
    return ProcessedRecording(raw, recording, 1.0 - float(free.mean()), sampled.rows, free)


def _estimate_calibration(spec: ExperimentSpec, loaded: LoadedRobot, task: Task) -> Calibration:
    """In-situ calibration of the measured sensor, with known payloads on the same motion."""
    readings, known = [], []
    # Run 0 is the identification itself: other runs have other noise, and the same sensor errors.
    for run, payload in enumerate(spec.signals["calibration"], 1):
        robot = load_robot(loaded.robot.manifest, parse_payload(payload), spec.free_base)
        cuts = tuple(subtree_at(robot, cut.at, ()) for cut in task.cuts)
        built = built_plant(spec, loaded, robot)
        sensors = MeasuredSensors(spec, built, replace(task, cuts=cuts), run)
        simulated = SimulatedRobot(
            spec, replace(loaded, robot=robot), built, partial(design_problem, robot)
        )
        recording = record(spec, simulated, sensors).recording
        instruments = instruments_of(robot, cuts)
        motion = instruments.motion(recording.motion)
        model = newton_euler(instruments.tree, instruments.tree.link_parameters(robot.phi), motion)
        assert recording.wrench is not None
        readings.append(recording.wrench[:, :6])
        known.append(model[:, robot.nv : robot.nv + 6])
    return fit_calibration(np.concatenate(readings), np.concatenate(known))


def _calibrated(recording: Recording, calibration: Calibration) -> Recording:
    """The recording with the reading of the first sensor corrected."""
    assert recording.wrench is not None
    wrench = recording.wrench.copy()
    wrench[:, :6] = calibration.apply(wrench[:, :6])
    return replace(recording, wrench=wrench)


def _free_samples(contacts: Any, recording: Recording, builder: ProblemBuilder) -> Array:
    """Mask (N,) of the samples without contact, declared or detected."""
    if contacts == "detect":
        measured = measured_signals(recording)
        return free_samples(*dense_rows(builder.build(recording.motion, measured)))
    return _outside(contacts, recording.t)


def _with_margin(free: Array, margin: int) -> Array:
    """Mask (N,) without the `margin` samples beside those that are not free.

    Raises UsageError where that leaves nothing.
    """
    touched = np.convolve(~free, np.ones(2 * margin + 1), "same") > 0.5
    if touched.all():
        raise UsageError(
            f"Contact periods and the {margin} samples beside each, which the filter of positions "
            "mixes with them, leave nothing of the recording."
        )
    return ~touched


def _part(recording: Recording, free: Array) -> Recording:
    """The samples of a recording that are `free` (N,); samples of different periods no longer
    correspond."""
    motion = recording.motion
    return replace(
        recording, t=motion.t[free], q=motion.q[free], v=motion.v[free], a=motion.a[free],
        tau=recording.tau[free], period=None,
        wrench=None if recording.wrench is None else recording.wrench[free],
    )  # fmt: skip


def _outside(periods: Any, t: Array) -> Array:
    """Mask (N,) of the times outside of all periods ("10 s to 25 s")."""
    free = np.ones(len(t), dtype=bool)
    for start, end in map(interval, periods):
        free &= ~((t >= start) & (t < end))
    if not free.any():
        raise UsageError(
            f"The contact periods {', '.join(periods)} leave nothing of a recording from "
            f"{t[0]:g} s to {t[-1]:g} s."
        )
    return free
