"""Simulated experiments: record, preprocess, build the problem; once for all estimators."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.excitation.design_problem import design_problem
from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import pooled
from sysid_bench.experiments.simulated.bounds import encoder_bound_std, pooled_bound
from sysid_bench.experiments.simulated.built_plant import built_plant
from sysid_bench.experiments.simulated.noise_free import NoiseFreePart, noise_free_part
from sysid_bench.experiments.simulated.problem import (
    KnownTorque,
    ProblemBuilder,
    SimulatedModel,
    check_simulation,
    measured_signals,
    regressor_blocks,
)
from sysid_bench.experiments.simulated.record import (
    Repetition,
    SampledRecording,
    SimulatedRobot,
    record,
    record_all,
    recordings_of,
)
from sysid_bench.experiments.simulated.sealed_robot import robot_of_plant
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
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.simulation.forward_steps import ForwardModel
from sysid_bench.types import Array, Experiment, Problem, Recording, Run
from sysid_bench.units import interval


def prepare_simulated(spec: ExperimentSpec, loaded: LoadedRobot) -> ExperimentData[SimulatedSource]:
    """The simulated experiment of a specification.

    Raises UnsupportedError or UsageError where there is none, with the reason.
    """
    noise_free = noise_free_part(spec, loaded)
    builder = noise_free.builder
    order = recordings_of(spec, noise_free.task)
    first_loaded = next(repetition for repetition in order if repetition.loaded)
    sampled = [
        _processed(spec, loaded, builder, one)
        for one in _recorded_motions(spec, noise_free, first_loaded)
    ]
    runs = _runs(spec, noise_free, order, Run(True, sampled[0].recording))
    experiments = [_experiment(noise_free, one, runs) for one in sampled]
    problem = pooled([experiment.problem for experiment in experiments])
    experiment = replace(experiments[0], problem=problem)
    _make_read_only(experiment)
    motion, free = sampled[0].recording.motion, sampled[0].free
    along = [builder.rows_along(one.recording.motion, one.rows) for one in sampled]
    source = SimulatedSource(
        spec=spec,
        noise_free=noise_free,
        motion=motion if free is None else _part(sampled[0].recording, free).motion,
        known=builder.known(motion)[:, builder.row_indices],
        bound=pooled_bound(builder, sampled),
        encoder_bound=encoder_bound_std(spec, builder, sampled[0]),
        left_out=_mean_share([(one.left_out, len(one.recording)) for one in sampled]),
        standstill=_mean_share([(one.left_out, one.samples) for one in along]),
        rows=sampled[0].rows,
        step=sampled[0].oracle.step,
    )
    held_out, moving = noise_free.held_out, noise_free.held_out_moving
    return ExperimentData(loaded.robot, problem, experiment, held_out, source, moving)


def _experiment(
    noise_free: NoiseFreePart, sampled: SampledRecording, runs: tuple[Run, ...]
) -> Experiment:
    """The problem of a recording, and the functions that methods may call."""
    builder, recording = noise_free.builder, sampled.recording
    rows, measured = builder.row_indices, measured_signals(recording)
    simulate: Callable[..., Recording] = check_simulation
    known: Callable[[Any], Array] = check_simulation
    forward: ForwardModel | None = None
    if not noise_free.task.cuts:
        candidate = Candidate(**(noise_free.spec.candidate or {}))
        simulate = SimulatedModel(noise_free.known_model, sampled.raw, candidate)
        known = KnownTorque(noise_free.known_model, rows)
        forward = ForwardModel(noise_free.known_model, builder.base.pivots)
    along = builder.rows_along(recording.motion, sampled.rows, sampled.free)
    return Experiment(
        problem=builder.build(recording.motion, measured, noise_free.prior, along),
        recording=recording,
        raw=sampled.raw,
        regress=partial(regressor_blocks, builder.regression, rows, builder.instruments),
        simulate=simulate,
        known=known,
        runs=runs,
        filter_rows=along.processed,
        forward=forward,
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


def _mean_share(shares: Sequence[tuple[float, int]]) -> float:
    """Mean of (share, samples), weighted by the samples."""
    if len(shares) == 1:
        return shares[0][0]
    total = sum(samples for _, samples in shares)
    return sum(share * samples for share, samples in shares) / total if total else 0.0


def _recorded_motions(
    spec: ExperimentSpec, noise_free: NoiseFreePart, first: Repetition
) -> list[SampledRecording]:
    """The recording of each training motion, one after the other; `first` is that of the first.

    Raises UnsupportedError for tasks, runs and excitations that allow one motion alone.
    """
    robots = noise_free.simulated_motions
    if MOTIONS in spec.redrawn:
        # The noise-free part is shared by all repeats, whose motions differ.
        robots = tuple(replace(robot, spec=spec) for robot in robots)
    if "runs" in spec.signals and (spec.motions > 1 or MOTIONS in spec.redrawn):
        raise UnsupportedError("Runs without the payload repeat one motion: leave out runs.")
    if spec.motions > 1 and noise_free.task.cuts:
        raise UnsupportedError(
            f"motions = {spec.motions}: tasks with force/torque sensors take one training motion."
        )
    if spec.motions > 1 and np.array_equal(robots[0].commanded.q, robots[1].commanded.q):
        raise UnsupportedError(
            f"motions = {spec.motions}: the excitation {spec.excitation['use']!r} gives the same "
            "motion for every seed. Choose one that draws it, as 'fourier', or motions = 1."
        )
    further = (Repetition(i, True, motion_noise_seed(spec, i)) for i in range(1, spec.motions))
    return record_all(spec, robots, [first, *further])


def _runs(
    spec: ExperimentSpec, noise_free: NoiseFreePart, order: tuple[Repetition, ...], main: Run
) -> tuple[Run, ...]:
    """All recordings of the commanded motion, `main` among them; none where it is the only one."""
    if len(order) == 1:
        return ()
    simulated = noise_free.simulated
    robot = load_robot(simulated.loaded.robot.manifest, parse_payload("none"), spec.free_base)
    robot = robot_of_plant(spec, robot, noise_free.task.parameters)
    bare = replace(simulated, built=built_plant(spec, simulated.loaded, robot))
    return tuple(
        main
        if one.seed == noise_seed(spec)
        else Run(one.loaded, record(spec, simulated if one.loaded else bare, one).recording)
        for one in order
    )


def _processed(
    spec: ExperimentSpec, loaded: LoadedRobot, builder: ProblemBuilder, sampled: SampledRecording
) -> SampledRecording:
    """The recording as the task needs it: sensors calibrated, contact periods left out.

    Raises UsageError where the contact periods leave nothing.
    """
    if "calibration" in spec.signals and builder.task.cuts:
        calibration = _estimate_calibration(spec, loaded, builder.task)
        raw, recording = (_calibrated(one, calibration) for one in (sampled.raw, sampled.recording))
        sampled = replace(sampled, raw=raw, recording=recording)
    contacts, recording = spec.signals.get("contacts"), sampled.recording
    if not contacts:
        return sampled
    free = _free_samples(contacts, recording, builder)
    if isinstance(sampled.rows.filter, NoFilter):
        recording = _part(recording, free)
        return replace(sampled, recording=recording, left_out=1.0 - float(free.mean()))
    # Without the samples beside those that are not free, which the filter of positions mixes.
    margin = sampled.margin
    free = ~(np.convolve(~free, np.ones(2 * margin + 1), "same") > 0.5)
    if not free.any():
        raise UsageError(
            f"Contact periods and the {margin} samples beside each, which the filter of positions "
            "mixes with them, leave nothing of the recording."
        )
    recording = replace(recording, period=None)
    return replace(sampled, recording=recording, left_out=1.0 - float(free.mean()), free=free)


def _estimate_calibration(spec: ExperimentSpec, loaded: LoadedRobot, task: Task) -> Calibration:
    """In-situ calibration of the measured sensor, with known payloads on the same motion."""
    readings, known = [], []
    # Run 0 is the identification itself: other runs have other noise, and the same sensor errors.
    for run, payload in enumerate(spec.signals["calibration"], 1):
        robot = load_robot(loaded.robot.manifest, parse_payload(payload), spec.free_base)
        robot = robot_of_plant(spec, robot, task.parameters)
        cuts = tuple(subtree_at(robot, cut.at, ()) for cut in task.cuts)
        simulated = SimulatedRobot(
            spec,
            replace(loaded, robot=robot),
            built_plant(spec, loaded, robot),
            replace(task, cuts=cuts),
            partial(design_problem, robot),
        )
        recording = record(spec, simulated, run=run).recording
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


def _part(recording: Recording, free: Array) -> Recording:
    """The samples of a recording that are `free` (N,); samples of different periods no longer
    correspond."""
    motion = recording.motion
    return replace(
        recording, t=motion.t[free], q=motion.q[free], v=motion.v[free], a=motion.a[free],
        tau=recording.tau[free], period=None,
        wrench=None if recording.wrench is None else recording.wrench[free],
    )  # fmt: skip
