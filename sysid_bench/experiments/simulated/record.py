"""Simulated recordings: a plant moves along an excitation, its sensors are read and filtered."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.evaluation.cramer_rao import torque_bound, white_bound
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.limit_margins import Margins
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.built_plant import (
    BuiltPlant,
    EncoderModel,
    MeasuredSensors,
    SampledSignals,
    run_with_encoder_errors,
)
from sysid_bench.experiments.simulated.commanded import CommandedMotion, commanded_motion
from sysid_bench.experiments.simulated.problem import ProblemBuilder, regressor_blocks
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    drift_seed,
    held_out_seed,
    motion_seed,
    noise_seed,
    run_seed,
)
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.signals.pipeline_choice import pipeline_of
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.sensors import Noise, measured_recording, noise_samples
from sysid_bench.simulation.wrench_sensors import WRENCH_NOISE
from sysid_bench.types import Array, Controller, Oracle, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class SimulatedRobot:
    """A plant that moves along an excitation."""

    spec: ExperimentSpec
    loaded: LoadedRobot
    built: BuiltPlant
    design_problem: Callable[[float], DesignProblem]  # of the model, at a rate (Hz)
    motion: int = 0  # index of the training motion

    @cached_property
    def simulation(self) -> Any:
        """The simulation plug-in."""
        return self.loaded.build_plugin("simulation", self.spec.simulation)

    @property
    def step_ratio(self) -> int:
        """Steps of the simulation per sample of the recording."""
        rate: float = self.simulation.design_rate(self.spec.rate)
        return round(rate / self.spec.rate)

    @cached_property
    def _training(self) -> CommandedMotion:
        """The training motion at the rate of the simulation, with its margins to the limits."""
        rate = self.simulation.design_rate(self.spec.rate)
        return self._checked(self.spec.excitation, rate, motion_seed(self.spec, self.motion))

    @property
    def commanded(self) -> Trajectory:
        """The commanded training motion, at the rate of the simulation."""
        return self._training.motion

    @cached_property
    def motions_held_out(self) -> tuple[CommandedMotion, ...]:
        """The held-out motions, at the rate of the recording; with elastic joints at that of the
        simulation."""
        return tuple(
            self._other(excitation, held_out_seed(self.spec, index))
            for index, excitation in enumerate(self.spec.held_out)
        )

    @property
    def margins(self) -> Margins:
        """Margins to the limits along all motions, held-out ones included."""
        margins = self._training.margins
        for other in self.motions_held_out:
            margins = margins.with_motion(other.margins)
        return margins

    def _other(self, excitation: Mapping[str, Any], seed: int) -> CommandedMotion:
        rate = self.spec.rate
        if self.built.plant.transmission is not None:
            rate = self.simulation.design_rate(rate)
        return self._checked(excitation, rate, seed)

    def _checked(self, excitation: Mapping[str, Any], rate: float, seed: int) -> CommandedMotion:
        return commanded_motion(excitation, self.loaded, self.design_problem(rate), seed)

    def run(self, error: Array) -> tuple[Oracle, Controller | None]:
        """Ground truth of the plant's motion with encoder errors (N, n) of the model's joints, and
        the controller."""
        # Inverse dynamics reads no encoder: one run serves all errors.
        if type(self.simulation) is Inverse:
            return self._undisturbed, None
        return self._moved(self.simulation, self.commanded, error)

    def along(self, excitation: Mapping[str, Any], seed: int) -> Oracle:
        """Ground truth of the plant on another motion, at the rate of the recording."""
        return self.held_out(self._other(excitation, seed).motion)

    def held_out(self, motion: Trajectory) -> Oracle:
        """Ground truth of the plant on one of the other motions, at the rate of the recording."""
        if self.built.plant.transmission is None:
            return self._moved(Inverse(), motion, self._no_error(motion))[0]
        oracle = self._moved(self.simulation, motion, self._no_error(motion))[0]
        each = self.step_ratio
        return Oracle(sampled_motion(oracle.motion, each), oracle.tau[::each])

    @cached_property
    def _undisturbed(self) -> Oracle:
        return self._moved(self.simulation, self.commanded, self._no_error(self.commanded))[0]

    def _moved(
        self, simulation: Any, motion: Trajectory, error: Array
    ) -> tuple[Oracle, Controller | None]:
        joints = self.built.coordinates
        oracle, controller = simulation.run(
            self.built.plant, joints.to_plant(motion), joints.error_to_plant(error)
        )
        return oracle, controller

    def _no_error(self, motion: Trajectory) -> Array:
        return np.zeros((len(motion), len(self.built.model.torque_dofs)))


@dataclass(frozen=True)
class Repetition:
    """One recording of the commanded motion: its index, and whether the payload is mounted."""

    index: int
    loaded: bool
    seed: int  # of its noise


def recordings_of(spec: ExperimentSpec, task: Task) -> tuple[Repetition, ...]:
    """The recordings of an experiment in order, "A" without and "B" with the payload.

    The first loaded one has the noise that it has without the others, so that comparisons are
    paired. Raises UnsupportedError for tasks and signals that allow one recording alone.
    """
    order = spec.signals.get("runs", "B")
    if "A" in order and (task.cuts or not task.definition.supports_runs_without_payload):
        raise UnsupportedError(
            "Runs without the payload identify the payload, from joint torques alone; the task is "
            f"{task.name!r}{' with sensors' if task.cuts else ''}."
        )
    if len(order) > 1 and spec.signals.get("contacts"):
        raise UnsupportedError(
            "Contact periods leave different samples of each run: choose runs or contacts."
        )
    first = order.index("B")
    return tuple(
        Repetition(i, letter == "B", noise_seed(spec) if i == first else run_seed(spec, i))
        for i, letter in enumerate(order)
    )


@dataclass(frozen=True, eq=False)
class SampledRecording:
    """A recording before (`raw`) and after filters, and what scoring alone may know of it."""

    raw: Recording
    recording: Recording
    oracle: Oracle
    decimation: int  # steps of the simulation per sample
    has_exact_model: bool  # neither the model nor the sensors have errors beside the noise
    torque_std: Array  # (n,) of the torque noise
    correlation: float  # of that noise from sample to sample
    rows: RowProcessing = field(default_factory=RowProcessing)  # of W beta = b
    margin: int = 0  # samples beside a disturbed one that a filter of positions mixes with it

    def has_torque_noise(self, builder: ProblemBuilder) -> bool:
        """True where each row is a torque with noise, and nothing else has errors."""
        if builder.task.cuts or not self.has_exact_model:
            return False
        return bool((self.torque_std[list(builder.row_indices)] > 0).all())

    def cramer_rao_bound(self, builder: ProblemBuilder) -> Array | None:
        """The Cramer-Rao bound (r, r) of the covariance where torque alone is noisy; None where
        a row has no noise of that kind, where the model or the sensors have other errors, or the
        motion does not excite every direction."""
        if not self.has_torque_noise(builder):
            return None
        return _bound(
            builder, self.oracle, self.decimation, tuple(self.torque_std), self.correlation
        )


@lru_cache(maxsize=2)
def _bound(
    builder: ProblemBuilder,
    oracle: Oracle,
    decimation: int,
    std: tuple[float, ...],
    correlation: float,
) -> Array | None:
    motion, rows = sampled_motion(oracle.motion, decimation), builder.row_indices
    row_std = np.array(std)[list(rows)]
    if correlation == 0.0:
        covariance = white_bound(builder.build(motion, oracle.tau[::decimation]), row_std)
    else:  # whitening in time mixes samples: the blocks have to be dense
        blocks = regressor_blocks(builder.regression, rows, builder.instruments, motion)
        covariance = torque_bound(blocks, np.diag(row_std**2), correlation)
    return covariance


def record(
    spec: ExperimentSpec,
    simulated: SimulatedRobot,
    sensors: MeasuredSensors,
    repetition: Repetition | None = None,
) -> SampledRecording:
    """The recording of one repeat, and of one of its runs where there are several."""
    repetition = repetition or Repetition(0, True, noise_seed(spec))
    seed, built, decimation = repetition.seed, simulated.built, simulated.step_ratio
    noise = Noise(**{key: x for key, x in spec.noise.items() if key not in WRENCH_NOISE})
    pipeline = pipeline_of(spec.pipeline, spec.signals, simulated.loaded.folder)
    rng, count = np.random.default_rng(seed), len(simulated.commanded)
    samples = len(range(0, count, decimation))
    # All draws before the run, in units of their deviation: levels of noise share the same draws.
    draws = noise_samples(count, samples, len(built.model.torque_dofs), rng)
    run = run_with_encoder_errors(EncoderModel(built, noise, draws), simulated.run)
    # A relative level refers to the exact torque, so that the noise is independent of itself.
    torque_std = noise.torque_std(run.seen.tau[::decimation])
    readings = run.read(built.random_by_stage(seed), decimation)
    torque_noise = torque_std * noise.torque_noise(draws.torque)
    raw = _raw_recording(simulated, readings, torque_noise, run.controller, pipeline.ideal_rates)
    drifting = _with_drift(spec, raw, repetition.index, noise.tau_drift)
    raw = sensors.recording(drifting, run.oracle, decimation)
    raw = built.chain.stored(raw, built.random_by_stage(seed))
    processed = pipeline.process(raw, built.model.joints)
    # Dependent joints are solved from the filtered independent ones: filtering each joint by itself
    # would violate the closure, which is nonlinear.
    motion = built.model.completed(processed.recording.motion)
    return SampledRecording(
        raw=raw,
        recording=replace(processed.recording, q=motion.q, v=motion.v, a=motion.a),
        oracle=run.seen,
        decimation=decimation,
        has_exact_model=built.has_exact_model,
        torque_std=torque_std,
        correlation=noise.tau_correlation,
        rows=processed.rows,
        margin=processed.margin,
    )


def _raw_recording(
    simulated: SimulatedRobot,
    sampled: SampledSignals,
    torque_noise: Array,
    controller: Controller | None,
    ideal_rates: bool,
) -> Recording:
    """The recording of sampled signals before wrenches and the errors of its storage."""
    return measured_recording(
        simulated.built.model,
        sampled.signals,
        sampled.error,
        torque_noise,
        sampled.stride,
        # Without a controller the robot moves exactly as commanded, which is the ground truth.
        commanded=None if controller is None else simulated.commanded,
        controller=controller,
        ideal_rates=ideal_rates,
    )


def _with_drift(spec: ExperimentSpec, recording: Recording, index: int, level: float) -> Recording:
    """The recording with linear torque drift (N m/s, N/s) since the first run; runs follow each
    other without a pause."""
    if level == 0.0:
        return recording
    slope = level * np.random.default_rng(drift_seed(spec)).normal(size=recording.tau.shape[1])
    # Drift is common to all runs, so that differences of runs contain it.
    start = index * len(recording) / recording.rate
    return replace(recording, tau=recording.tau + (recording.t + start)[:, None] * slope)


def held_out_motions(spec: ExperimentSpec, simulated: SimulatedRobot) -> dict[str, Oracle]:
    """Ground truth of other motions of the same plant, by excitation, for scoring.

    By inverse dynamics, whatever the training uses: the motion is exactly the commanded one. Links
    behind elastic transmissions cannot follow it, and are simulated as in training; theirs is the
    motion that scores are based on.
    """
    motions: dict[str, Oracle] = {}
    for index, excitation in enumerate(spec.held_out):
        name = excitation["use"]
        oracle = simulated.held_out(simulated.motions_held_out[index].motion)
        motions[name if name not in motions else f"{name}-{index}"] = oracle
    return motions
