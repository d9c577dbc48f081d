"""Simulated recordings: a plant moves along an excitation, its sensors are read and filtered."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.limit_margins import Margins
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.built_plant import BuiltPlant
from sysid_bench.experiments.simulated.commanded import CommandedMotion, commanded_motion
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    drift_seed,
    held_out_seed,
    motion_seed,
    noise_seed,
    run_seed,
    seed_of,
    sensor_seed,
)
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import end_body
from sysid_bench.signals.pipeline_choice import pipeline_of
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.simulation import sensors, wrench_sensors
from sysid_bench.simulation.inverse import Inverse, joint_positions
from sysid_bench.simulation.tracking_control import TrackingControl
from sysid_bench.types import Array, Controller, Oracle, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class SimulatedRobot:
    """A plant that moves along an excitation, with the sensors of a task."""

    spec: ExperimentSpec
    loaded: LoadedRobot
    built: BuiltPlant
    task: Task
    design_problem: Callable[[float], DesignProblem]  # of the model, at a rate (Hz)
    motion: int = 0  # index of the training motion

    @cached_property
    def simulation(self) -> Any:
        """The simulation plug-in."""
        return self.loaded.build_plugin("simulation", self.spec.simulation)

    @property
    def _rate(self) -> float:
        """Rate of the simulation (Hz)."""
        rate: float = self.simulation.design_rate(self.spec.rate)
        return rate

    @property
    def step_ratio(self) -> int:
        """Steps of the simulation per sample of the recording."""
        return round(self._rate / self.spec.rate)

    @cached_property
    def _training(self) -> CommandedMotion:
        """The training motion at the rate of the simulation, with its margins to the limits."""
        seed = motion_seed(self.spec, self.motion)
        return self._checked(self.spec.excitation, self._rate, seed)

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
        elastic = self.built.plant.transmission is not None
        return self._checked(excitation, self._rate if elastic else self.spec.rate, seed)

    def _checked(self, excitation: Mapping[str, Any], rate: float, seed: int) -> CommandedMotion:
        return commanded_motion(excitation, self.loaded, self.design_problem(rate), seed)

    def along(self, excitation: Mapping[str, Any], seeds: Iterable[int]) -> list[Oracle]:
        """Ground truth of the plant on other motions, at the rate of the recording."""
        return self._held_out([self._other(excitation, seed).motion for seed in seeds])

    @cached_property
    def held_out(self) -> dict[str, Oracle]:
        """Ground truth of the held-out motions, by excitation, for scoring."""
        motions: dict[str, Oracle] = {}
        oracles = self._held_out([one.motion for one in self.motions_held_out])
        for index, (excitation, oracle) in enumerate(zip(self.spec.held_out, oracles, strict=True)):
            name = excitation["use"]
            motions[name if name not in motions else f"{name}-{index}"] = oracle
        return motions

    def _held_out(self, motions: Sequence[Trajectory]) -> list[Oracle]:
        # By inverse dynamics, whatever the training uses: the motion is exactly the commanded one.
        if self.built.plant.transmission is None:
            return [oracle for oracle, _ in self.moved(Inverse(), motions)]
        # Links behind elastic transmissions cannot follow it, and are simulated as in training;
        # theirs is the motion that scores are based on.
        each, oracles = self.step_ratio, [x for x, _ in self.moved(self.simulation, motions)]
        return [Oracle(sampled_motion(x.motion, each), x.tau[::each]) for x in oracles]

    @cached_property
    def undisturbed(self) -> Oracle:
        """Ground truth of the plant's motion without encoder errors."""
        return self.moved(self.simulation, [self.commanded])[0][0]

    def moved(
        self, simulation: Any, motions: Sequence[Trajectory], errors: Sequence[Array] | None = None
    ) -> list[tuple[Oracle, Controller | None]]:
        """Ground truth of the plant along motions of the model, with encoder errors (N, n) of the
        model's joints (None: without), and the controller."""
        joints, plant = self.built.coordinates, self.built.plant
        if errors is None:
            width = len(self.built.model.torque_dofs)
            errors = [np.zeros((len(motion), width)) for motion in motions]
        along = [joints.to_plant(motion) for motion in motions]
        errors = [joints.error_to_plant(error) for error in errors]
        # A subclass may have a run of its own.
        if type(simulation) is TrackingControl:
            return simulation.run_many(plant, along, errors)
        return [simulation.run(plant, x, e) for x, e in zip(along, errors, strict=True)]

    def noise_free(self, oracle: Oracle) -> tuple[Trajectory, Array]:
        """The plant's motion as the model counts it, and the noise-free torques and wrenches (N,
        nv + 6 sensors), with the constant offsets of the sensors where those are among the
        unknowns."""
        seen, task = self.built.coordinates.to_model(oracle), self.task
        if not task.cuts:
            return seen.motion, seen.tau
        wrench = wrench_sensors.sensor_wrench(self.built.plant, task.cuts, oracle.motion)
        # Constant offsets are unknowns of a task that has more than ten parameters for each body.
        if task.definition.measures_sensor_only and len(task.parameters) > 10 * len(task.bodies):
            wrench += task.truth.theta[10 * len(task.bodies) :]
        return seen.motion, np.hstack([seen.tau, wrench])


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
    """A recording before (`raw`) and after filters, and what scoring alone may know of it.

    `rows` of W beta = b are still to be processed. Contact periods were the share `left_out` of
    the samples; a filter of rows cannot cross gaps, and contacts then stay in the recording:
    samples that are not `free` (N,) are without weight before the filter. None: all are free.
    """

    raw: Recording
    recording: Recording
    oracle: Oracle
    decimation: int  # steps of the simulation per sample
    has_exact_model: bool  # neither the model nor the sensors have errors beside the noise
    torque_std: Array  # (n,) of the torque noise
    correlation: float  # of that noise from sample to sample
    rows: RowProcessing = field(default_factory=RowProcessing)
    margin: int = 0  # samples beside a disturbed one that a filter of positions mixes with it
    left_out: float = 0.0
    free: Array | None = None


def record(
    spec: ExperimentSpec,
    simulated: SimulatedRobot,
    repetition: Repetition | None = None,
    run: int = 0,
) -> SampledRecording:
    """The recording of one repeat, and of one of its runs where there are several; force/torque
    sensors have the same errors in each `run`, and other noise."""
    return record_all(
        spec, [simulated], [repetition or Repetition(0, True, noise_seed(spec))], run
    )[0]


def record_all(
    spec: ExperimentSpec,
    robots: Sequence[SimulatedRobot],
    repetitions: Sequence[Repetition],
    run: int = 0,
) -> list[SampledRecording]:
    """The recordings of one plant along its motions, of a repetition each."""
    noise = sensors.Noise(
        **{key: x for key, x in spec.noise.items() if key not in wrench_sensors.WRENCH_NOISE}
    )
    runs = _noisy_runs(robots, noise, [one.seed for one in repetitions])
    return [_sampled(spec, *one, run) for one in zip(robots, repetitions, runs, strict=True)]


def _sampled(
    spec: ExperimentSpec,
    simulated: SimulatedRobot,
    repetition: Repetition,
    noisy: tuple["_NoisyRun", Array],
    run: int,
) -> SampledRecording:
    """The recording of a noisy run, with the draws (K, n) of its torque noise."""
    built, model = simulated.built, simulated.built.model
    (moved, torque_draws), noise = noisy, noisy[0].noise
    pipeline = pipeline_of(spec.pipeline, spec.signals, simulated.loaded.folder)
    # A relative level refers to the exact torque, so that the noise is independent of itself.
    torque_std = noise.torque_std(moved.seen.tau[:: simulated.step_ratio])
    torque_noise = torque_std * noise.torque_noise(torque_draws)
    raw = moved.recording(simulated, repetition.seed, torque_noise, pipeline.ideal_rates)
    if noise.tau_drift:
        raw = _with_drift(raw, noise.tau_drift, drift_seed(spec), repetition.index)
    if simulated.task.cuts:
        raw = _with_wrenches(spec, simulated, raw, moved.oracle, run)
    raw = built.chain.stored(raw, built.random_by_stage(repetition.seed))
    processed = pipeline.process(raw, model.joints)
    # Dependent joints are solved from the filtered independent ones: filtering each joint by itself
    # would violate the closure, which is nonlinear.
    motion = model.completed(processed.recording.motion)
    return SampledRecording(
        raw=raw,
        recording=replace(processed.recording, q=motion.q, v=motion.v, a=motion.a),
        oracle=moved.seen,
        decimation=simulated.step_ratio,
        has_exact_model=built.has_exact_model,
        torque_std=torque_std,
        correlation=noise.tau_correlation,
        rows=processed.rows,
        margin=processed.margin,
    )


def _with_drift(raw: Recording, drift: float, seed: int, index: int) -> Recording:
    """The recording with a drift of its torques (N m/s, N/s). It is common to all runs, which
    follow each other without a pause, so that differences of runs contain it."""
    draw = np.random.default_rng(seed).normal(size=raw.tau.shape[1])
    start = index * len(raw) / raw.rate
    return replace(raw, tau=raw.tau + (raw.t + start)[:, None] * (drift * draw))


@dataclass(frozen=True, eq=False)
class _NoisyRun:
    """A run whose loop saw the errors (N, n) of its encoders: the plant's ground truth `oracle`,
    the same as the model counts it (`seen`), and the controller."""

    noise: sensors.Noise
    draws: Array  # (N, n), standard normal
    oracle: Oracle
    seen: Oracle
    controller: Controller | None
    error: Array

    def recording(
        self, simulated: SimulatedRobot, seed: int, torque_noise: Array, ideal_rates: bool
    ) -> Recording:
        """The recording after the transducers and the sampling, with torque noise (K, n)."""
        built, every = simulated.built, simulated.step_ratio
        chain, model, rng_of = built.chain, built.model, built.random_by_stage(seed)
        signals, error, stride = self.seen, self.error, every
        if chain.has(sensors.TorqueStage):
            q = _independent_positions(model, signals.motion)
            rms = np.sqrt((signals.tau**2).mean(axis=0))
            exact = sensors.TorqueSignal(signals.motion.t, q, signals.tau, rms)
            signals = replace(signals, tau=chain.torque_reading(exact, rng_of))
        if chain.has(sensors.SamplingStage):
            stamps, joints = signals.motion.t[::every], len(model.torque_dofs)
            late = chain.sampling_delay(stamps, joints, rng_of)
            signals, stride = sensors.sampled_with_delay(model, signals, every, *late), 1
            # Encoders are read late, and then rounded: readings stay on their grid.
            error = _encoder_error(built, self.noise, self.draws[::every], signals.motion)
        return sensors.measured_recording(
            model,
            signals,
            error,
            torque_noise,
            stride,
            # Without a controller the robot moves exactly as commanded, which is the ground truth.
            commanded=None if self.controller is None else simulated.commanded,
            controller=self.controller,
            ideal_rates=ideal_rates,
        )


def _noisy_runs(
    robots: Sequence[SimulatedRobot], noise: sensors.Noise, seeds: Sequence[int]
) -> list[tuple[_NoisyRun, Array]]:
    """Move one plant along its motions with a loop that sees the errors of its encoders; return
    the draws (K, n) of the torque noise of each as well."""
    first, built = robots[0], robots[0].built
    draws, torque_draws, n = [], [], len(built.model.torque_dofs)
    # All draws before the run, in units of their deviation: levels of noise share the same draws.
    for robot, seed in zip(robots, seeds, strict=True):
        rng, steps = np.random.default_rng(seed), range(len(robot.commanded))
        draws.append(rng.normal(size=(len(steps), n)))
        torque_draws.append(rng.normal(size=(len(steps[:: robot.step_ratio]), n)))

    def run(errors: list[Array]) -> list[tuple[Oracle, Controller | None]]:
        # Inverse dynamics reads no encoder: one run serves all errors.
        if type(first.simulation) is Inverse:
            return [(robot.undisturbed, None) for robot in robots]
        return first.moved(first.simulation, [robot.commanded for robot in robots], errors)

    def seen_by_model(oracle: Oracle) -> Oracle:
        return built.coordinates.to_model(replace(oracle, motion=oracle.measured, encoders=None))

    def errors_along(moved: list[tuple[Oracle, Controller | None]]) -> list[Array]:
        motions = [seen_by_model(oracle).motion for oracle, _ in moved]
        return [_encoder_error(built, noise, *one) for one in zip(draws, motions, strict=True)]

    errors = [sensors.position_error(noise, one) for one in draws]
    moved = run(errors)
    if noise.quantum > 0 or built.chain.has(sensors.EncoderStage):
        # The first run gives positions, the second one runs with the loop seeing their errors. The
        # recorded errors are those of its own positions, so that readings lie on the encoder's
        # grid.
        moved = run(errors_along(moved))
        errors = errors_along(moved)
    runs = [
        _NoisyRun(noise, drawn, oracle, seen_by_model(oracle), controller, error)
        for drawn, (oracle, controller), error in zip(draws, moved, errors, strict=True)
    ]
    return list(zip(runs, torque_draws, strict=True))


def _encoder_error(
    built: BuiltPlant, noise: sensors.Noise, draws: Array, motion: Trajectory
) -> Array:
    """Errors (N, n) of encoders on a motion: white noise, rounding, and those of the chain."""
    robot, chain = built.model, built.chain
    q = _independent_positions(robot, motion)
    scalar = np.flatnonzero(np.isin(robot.torque_dofs, robot.scalar_dofs))
    repeated = chain.encoder_error(q) if chain.has(sensors.EncoderStage) else None
    return sensors.position_error(noise, draws, q, scalar, repeated)


def _independent_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Positions (N, n) of the joints with measured torque; zero for balls and free joints."""
    q: Array = joint_positions(robot, motion)[:, robot.torque_dofs]
    return q


def _with_wrenches(
    spec: ExperimentSpec, simulated: SimulatedRobot, raw: Recording, oracle: Oracle, run: int
) -> Recording:
    """The recording `raw` of the plant's motion with the readings of force/torque sensors.

    Raises UnsupportedError for a contact in a simulation that does not feel it.
    """
    cuts, plant = simulated.task.cuts, simulated.built.plant
    noise, seed = wrench_sensors.wrench_noise(spec.noise), noise_seed(spec)
    # A stream of its own: a sensor leaves the noise of torques and encoders as it is.
    white = np.random.default_rng(seed_of(seed, "wrench", run))
    motion, contact = sampled_motion(oracle.motion, simulated.step_ratio), None
    if noise.touch:
        if spec.simulation["use"] != "inverse":
            raise UnsupportedError(
                "A contact (noise.touch) needs the simulation 'inverse': it moves no robot."
            )
        # On the last body, during the middle third of the motion.
        rng = np.random.default_rng(seed_of(seed, "touched", run))
        wrench, part = wrench_sensors.random_wrench(motion, noise.touch, rng), len(motion) // 3
        wrench[:part] = wrench[2 * part :] = 0.0
        contact = wrench_sensors.Contact(end_body(plant.robot, cuts[0]), wrench)
        # The motors hold the robot on its motion against the contact.
        force = wrench_sensors.contact_torque(plant, contact, motion)
        tau = plant.robot.reduced(motion.q, force)
        raw = replace(raw, tau=raw.tau - simulated.built.coordinates.torque_to_model(tau))
    exact = wrench_sensors.sensor_wrench(plant, cuts, motion, contact)
    parts = [
        error.read(one, raw.t) + noise.white() * white.normal(size=one.shape)
        for error, one in zip(
            _sensor_errors(spec, len(cuts)), np.split(exact, len(cuts), axis=1), strict=True
        )
    ]
    rows = tuple(row for cut in cuts for row in cut.rows)
    return replace(raw, wrench=np.hstack(parts), wrench_rows=rows)


def sensor_offset(spec: ExperimentSpec, count: int) -> Array:
    """True offsets (6 count,) [n; f] of the measured sensor and of those that end its sub-tree."""
    return np.concatenate([error.offset for error in _sensor_errors(spec, count)])


def _sensor_errors(spec: ExperimentSpec, count: int) -> list[wrench_sensors.SensorError]:
    """Offset, drift, gain, crosstalk and mounting errors of each sensor of an experiment."""
    noise = wrench_sensors.wrench_noise(spec.noise)
    rng = np.random.default_rng(sensor_seed(spec))
    return [wrench_sensors.sensor_error(noise, rng) for _ in range(count)]
