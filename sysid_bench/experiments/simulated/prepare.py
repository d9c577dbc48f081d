"""Simulated experiments: record, preprocess, build the problem; once for all estimators."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.experiments.experiment_data import ExperimentData
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.pooled_problem import pooled
from sysid_bench.experiments.seed import noise_seed
from sysid_bench.experiments.simulated.built_plant import built_plant
from sysid_bench.experiments.simulated.encoder_bound import encoder_bound_std
from sysid_bench.experiments.simulated.estimator_model import (
    KnownTorque,
    SimulatedModel,
    check_simulation,
)
from sysid_bench.experiments.simulated.measured_sensors import MeasuredSensors
from sysid_bench.experiments.simulated.motions import (
    mean_share,
    pooled_bound,
    recorded_motions,
)
from sysid_bench.experiments.simulated.noise_free import NoiseFreePart, noise_free_part
from sysid_bench.experiments.simulated.problem import (
    ProblemBuilder,
    measured_signals,
    regressor_blocks,
)
from sysid_bench.experiments.simulated.process_recording import (
    ProcessedRecording,
    process_recording,
)
from sysid_bench.experiments.simulated.record import Repetition, record, recordings_of
from sysid_bench.experiments.simulated.source import SimulatedSource
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.simulation.candidate import Candidate
from sysid_bench.types import Array, Experiment, Problem, Recording, Run


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
