"""Simulated experiments: record, preprocess, build the problem; once for all estimators."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.cramer_rao import encoder_bound
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import pooled, sampled_motion
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
    mean_share,
    pooled_bound,
    record,
    recorded_motions,
    recordings_of,
)
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.spec import ExperimentSpec, noise_seed
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.identification.contact_free import free_samples
from sysid_bench.identification.linear.recursive_estimation import rows_of
from sysid_bench.identification.sensor_calibration import Calibration, fit_calibration
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.sensor import instruments_of, subtree_at
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.signals.filter import NoFilter
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.types import Array, Experiment, Problem, Recording, Run, Trajectory
from sysid_bench.units import interval

LONGEST: Final = 20_000
"""Samples up to which the bound is computed: W is dense here."""

SMALL: Final = 1e-6
"""Steps (rad, m, and per second) of the central differences of the torque."""

Torque = Callable[[Trajectory], Array]
"""Motion -> torque (N, rows) of the task's rows."""


def encoder_bound_std(
    spec: ExperimentSpec, builder: ProblemBuilder, sampled: SampledRecording
) -> Array | None:
    """The bound as standard deviations (r,); None where noise is not white and of both encoders and
    torques, where joints are coupled or not scalar, for several motions, and for repeats after the
    first, whose motions differ by noise alone."""
    is_first = spec.repeat == 0 and spec.motions == 1
    if not is_first or not _is_white(spec) or not _has_own_encoders(builder):
        return None
    if not sampled.has_torque_noise(builder):
        return None
    motion = sampled_motion(sampled.oracle.motion, sampled.decimation)
    if not 3 <= len(motion) <= LONGEST:
        return None
    rows = list(builder.row_indices)
    instruments, regression = builder.instruments, builder.regression
    W = np.concatenate(list(regressor_blocks(regression, builder.row_indices, instruments, motion)))
    beta = builder.base.K @ builder.task.truth.theta

    def torque(moved: Trajectory) -> Array:
        own = regression.torque(instruments.motion(moved), beta)
        return np.asarray((own + builder.known(moved))[:, rows])

    q_std = np.full(builder.robot.nv, float(spec.noise["q"]))
    step = float(motion.t[1] - motion.t[0])
    bound = encoder_bound(
        W, _torque_jacobians(torque, motion), step, q_std, sampled.torque_std[rows]
    )
    return None if bound is None else np.sqrt(np.diag(bound))


def _is_white(spec: ExperimentSpec) -> bool:
    """True for white noise of encoders and torques, without rounding."""
    noise = spec.noise
    return noise.get("q", 0.0) > 0 and not ({"quantum", "tau_correlation"} & set(noise))


def _has_own_encoders(builder: ProblemBuilder) -> bool:
    """True where each degree of freedom is a scalar joint with an encoder."""
    robot = builder.robot
    return robot.coupling is None and len(robot.scalar_dofs) == robot.nv == len(robot.torque_dofs)


def _torque_jacobians(torque: Torque, motion: Trajectory) -> tuple[Array, Array, Array]:
    """Derivatives (N, rows, n) of the torque by q, v and a, by central differences. Where a step
    crosses a standstill the Coulomb torque jumps, and the sample counts for nothing."""
    slopes = []
    for name in ("q", "v", "a"):
        values, columns = getattr(motion, name), []
        for j in range(values.shape[1]):
            step = np.zeros(values.shape[1])
            step[j] = SMALL
            ahead, behind = (
                torque(replace(motion, **{name: values + sign * step})) for sign in (1.0, -1.0)
            )
            columns.append((ahead - behind) / (2 * SMALL))
        slopes.append(np.stack(columns, axis=-1))
    return slopes[0], slopes[1], slopes[2]


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
        return free_samples(*rows_of(builder.build(recording.motion, measured)))
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
    source = SimulatedSource(
        spec=spec,
        noise_free=noise_free,
        motion=processed[0].motion_without_contact,
        known=builder.known(motion)[:, builder.row_indices],
        bound=pooled_bound([one.cramer_rao_bound(builder) for one in sampled]),
        encoder_bound=encoder_bound_std(spec, builder, sampled[0]),
        left_out=mean_share([(one.left_out, len(one.recording)) for one in processed]),
        standstill=_standstill(builder, processed),
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


def _standstill(builder: ProblemBuilder, processed: Sequence[ProcessedRecording]) -> float:
    """Share of the rows of all motions that are left out as standstill."""
    along = [builder.rows_along(one.recording.motion, one.rows) for one in processed]
    return mean_share([(one.left_out, one.samples) for one in along])


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
    for part in _parts(value):
        _make_read_only(part)


def _parts(value: Any) -> Iterable[Any]:
    """The values that a tuple, a partial or a type that methods are given holds."""
    if isinstance(value, tuple):
        return value
    if isinstance(value, partial):
        return value.args
    # Types of other modules, such as a robot, have caches that are filled later.
    if is_dataclass(value) and type(value).__module__ == Problem.__module__:
        return [getattr(value, field.name) for field in fields(value)]
    return ()


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
