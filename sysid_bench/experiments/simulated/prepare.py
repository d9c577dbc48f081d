"""Simulated experiments: record, preprocess, build the problem; once for all estimators."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import pooled
from sysid_bench.experiments.simulated.bounds import encoder_bound_std, pooled_bound
from sysid_bench.experiments.simulated.built_plant import MeasuredSensors, built_plant
from sysid_bench.experiments.simulated.noise_free import (
    KnownTorque,
    NoiseFreePart,
    SimulatedModel,
    check_simulation,
    noise_free_part,
)
from sysid_bench.experiments.simulated.problem import (
    ProblemBuilder,
    measured_signals,
    regressor_blocks,
)
from sysid_bench.experiments.simulated.record import (
    Repetition,
    SampledRecording,
    SimulatedRobot,
    record,
    recordings_of,
)
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.spec import MOTIONS, ExperimentSpec, motion_noise_seed, noise_seed
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.identification.linear.least_squares import dense_rows
from sysid_bench.identification.wrench_sensor import Calibration, fit_calibration, free_samples
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.sensor import instruments_of, subtree_at
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.signals.filter import NoFilter
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.types import Array, Experiment, Problem, Recording, Run, Trajectory
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
    free = np.ones(len(recording.t), dtype=bool)
    for start, end in map(interval, contacts):
        free &= ~((recording.t >= start) & (recording.t < end))
    if not free.any():
        raise UsageError(
            f"The contact periods {', '.join(contacts)} leave nothing of a recording from "
            f"{recording.t[0]:g} s to {recording.t[-1]:g} s."
        )
    return free


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


def prepare_simulated(spec: ExperimentSpec, loaded: LoadedRobot) -> ExperimentData[SimulatedSource]:
    """The simulated experiment of a specification.

    Raises UnsupportedError or UsageError where there is none, with the reason.
    """
    noise_free = noise_free_part(spec, loaded)
    builder = noise_free.builder
    order = recordings_of(spec, noise_free.task)
    first_loaded = next(repetition for repetition in order if repetition.loaded)
    sampled = recorded_motions(spec, noise_free, first_loaded)
    processed = [process_recording(spec, loaded, builder, one) for one in sampled]
    runs = _runs(spec, noise_free, order, Run(True, processed[0].recording))
    experiments = [_experiment(noise_free, one, runs) for one in processed]
    problem = pooled([experiment.problem for experiment in experiments])
    experiment = replace(experiments[0], problem=problem)
    _make_read_only(experiment)
    motion = processed[0].recording.motion
    along = [builder.rows_along(one.recording.motion, one.rows) for one in processed]
    source = SimulatedSource(
        spec=spec,
        noise_free=noise_free,
        motion=processed[0].motion_without_contact,
        known=builder.known(motion)[:, builder.row_indices],
        bound=pooled_bound([one.cramer_rao_bound(builder) for one in sampled]),
        encoder_bound=encoder_bound_std(spec, builder, sampled[0]),
        left_out=mean_share([(one.left_out, len(one.recording)) for one in processed]),
        standstill=mean_share([(one.left_out, one.samples) for one in along]),
        rows=processed[0].rows,
        step=sampled[0].oracle.step,
    )
    return ExperimentData(
        loaded.robot,
        experiment.problem,
        experiment,
        noise_free.held_out,
        source,
        noise_free.held_out_moving,
    )


def _experiment(
    noise_free: NoiseFreePart, processed: ProcessedRecording, runs: tuple[Run, ...]
) -> Experiment:
    """The problem of a recording, and the functions that methods may call."""
    builder, recording = noise_free.builder, processed.recording
    rows, measured = builder.row_indices, measured_signals(recording)
    simulate: Callable[..., Recording] = check_simulation
    known: Callable[[Any], Array] = check_simulation
    if not noise_free.task.cuts:
        candidate = Candidate(**(noise_free.spec.candidate or {}))
        simulate = SimulatedModel(noise_free.known_model, processed.raw, candidate)
        known = KnownTorque(noise_free.known_model, rows)
    along = builder.rows_along(recording.motion, processed.rows, processed.free)
    return Experiment(
        problem=builder.build(recording.motion, measured, noise_free.prior, along),
        recording=recording,
        raw=processed.raw,
        regress=partial(regressor_blocks, builder.regression, rows, builder.instruments),
        simulate=simulate,
        known=known,
        runs=runs,
        filter_rows=along.processed,
    )


def _make_read_only(value: Any) -> None:
    """Make the arrays of a frozen type read-only: the estimators of one experiment share them."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    parts: Iterable[Any] = ()
    if isinstance(value, tuple):
        parts = value
    elif isinstance(value, partial):
        parts = value.args
    # Types of other modules, such as a robot, have caches that are filled later.
    elif is_dataclass(value) and type(value).__module__ == Problem.__module__:
        parts = [getattr(value, field.name) for field in fields(value)]
    for part in parts:
        _make_read_only(part)


def _runs(
    spec: ExperimentSpec, noise_free: NoiseFreePart, order: tuple[Repetition, ...], main: Run
) -> tuple[Run, ...]:
    """All recordings of the commanded motion, `main` among them; none where it is the only one."""
    if len(order) == 1:
        return ()
    loaded = noise_free.simulated
    robot = load_robot(loaded.loaded.robot.manifest, parse_payload("none"), spec.free_base)
    robots = {True: loaded, False: replace(loaded, built=built_plant(spec, loaded.loaded, robot))}
    runs = []
    for repetition in order:
        if repetition.seed == noise_seed(spec):
            runs.append(main)
            continue
        simulated = robots[repetition.loaded]
        sensors = MeasuredSensors(spec, simulated.built, noise_free.task)
        sampled = record(spec, simulated, sensors, repetition)
        runs.append(Run(repetition.loaded, sampled.recording))
    return tuple(runs)


def recorded_motions(
    spec: ExperimentSpec, noise_free: NoiseFreePart, first: Repetition
) -> list[SampledRecording]:
    """The recording of each training motion, one after the other; `first` is that of the first.

    Raises UnsupportedError for tasks, runs and excitations that allow one motion alone.
    """
    trainings = noise_free.simulated_motions
    if MOTIONS in spec.redrawn:
        # The noise-free part is shared by all repeats, whose motions differ.
        trainings = tuple(replace(training, spec=spec) for training in trainings)
    _check_different(spec, noise_free, trainings)
    sensors = MeasuredSensors(spec, noise_free.simulated.built, noise_free.task)
    order = [
        first,
        *(Repetition(i, True, motion_noise_seed(spec, i)) for i in range(1, spec.motions)),
    ]
    return [
        record(spec, training, sensors, repetition)
        for training, repetition in zip(trainings, order, strict=True)
    ]


def _check_different(
    spec: ExperimentSpec, noise_free: NoiseFreePart, trainings: Sequence[SimulatedRobot]
) -> None:
    """Raise UnsupportedError where several motions cannot be used, or all are the same one."""
    if "runs" in spec.signals and (spec.motions > 1 or MOTIONS in spec.redrawn):
        raise UnsupportedError("Runs without the payload repeat one motion: leave out runs.")
    if spec.motions == 1:
        return
    if noise_free.task.cuts:
        raise UnsupportedError(
            f"motions = {spec.motions}: tasks with force/torque sensors take one training motion."
        )
    first, second = trainings[0].commanded, trainings[1].commanded
    if np.array_equal(first.q, second.q):
        raise UnsupportedError(
            f"motions = {spec.motions}: the excitation {spec.excitation['use']!r} gives the same "
            "motion for every seed. Choose one that draws it, as 'fourier', or motions = 1."
        )


def mean_share(shares: Sequence[tuple[float, int]]) -> float:
    """Mean of (share, samples), weighted by the samples."""
    if len(shares) == 1:
        return shares[0][0]
    total = sum(samples for _, samples in shares)
    return sum(share * samples for share, samples in shares) / total if total else 0.0
