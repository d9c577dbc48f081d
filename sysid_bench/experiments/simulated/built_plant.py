"""The plant of an experiment, the identified model beside it, and the sensors between them."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    PlantEntry,
    check_limits,
    composed_plant,
)
from sysid_bench.experiments.spec import (
    ExperimentSpec,
    noise_seed,
    plant_seed,
    seed_of,
    sensor_seed,
)
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import end_body
from sysid_bench.plugin_names import plugin_fields
from sysid_bench.simulation.inverse import joint_positions
from sysid_bench.simulation.model_errors import PlantCoordinates, with_model_errors
from sysid_bench.simulation.plant import Plant, coupling_law, plant_of
from sysid_bench.simulation.sensors import (
    EncoderStage,
    Noise,
    NoiseSamples,
    RngOf,
    SamplingStage,
    SensorChain,
    TorqueSignal,
    TorqueStage,
    position_error,
    sampled_with_delay,
    sensor_chain,
)
from sysid_bench.simulation.size import ANGLE, SLIDE, is_random, is_rotation, random_size
from sysid_bench.simulation.wrench_sensors import (
    Contact,
    SensorError,
    contact_torque,
    random_wrench,
    sensor_error,
    sensor_wrench,
    wrench_noise,
)
from sysid_bench.types import Array, Controller, Oracle, Recording, Row, Trajectory
from sysid_bench.units import quantity


@dataclass(frozen=True, eq=False)
class BuiltPlant:
    """A plant, the robot `model` that is identified, and the sensor chain.

    Motions are designed for the model, regressors and known parts are its own; the plant alone
    moves. `values`: the sizes that were drawn, as fields of a row.
    """

    plant: Plant
    model: RobotModel
    chain: SensorChain
    entries: tuple[PlantEntry, ...]  # of the stages of `chain`
    values: tuple[Row, ...] = ()

    @property
    def coordinates(self) -> PlantCoordinates:
        """The change between the joints of the plant and those of the model."""
        return PlantCoordinates(self.model, self.plant.robot)

    @property
    def has_exact_model(self) -> bool:
        """True where neither the model nor the sensors have errors."""
        return self.chain.is_exact and self.plant.robot is self.model

    @property
    def is_matched(self) -> bool:
        """True where the plant is the model: no effects, no errors of the model."""
        own = len(coupling_law(self.plant.terms))
        unmodelled = len(self.plant.laws) > own or self.plant.transmission is not None
        return self.plant.robot is self.model and not unmodelled

    def random_by_stage(self, seed: int) -> RngOf:
        """Generators of the stages of the chain for a recording with this noise seed."""

        def rng(stage: int) -> np.random.Generator:
            return np.random.default_rng(seed_of(seed, *self.entries[stage].channel))

        return rng


def built_plant(spec: ExperimentSpec, loaded: LoadedRobot, model: RobotModel) -> BuiltPlant:
    """The plant of a specification around `model`, whose errors are the same for all payloads.

    Raises UsageError for sizes that do not fit the robot.
    """
    composed, draws = composed_plant(spec.plant), _Draws(spec, loaded, model)
    robot = with_model_errors(model, *draws.plugins(composed.of("errors")))
    sensors = composed.of("sensors")
    chain = sensor_chain(model, *draws.plugins(sensors))
    effects, _ = draws.plugins(composed.of("effects"))
    values = tuple(row for entry in composed.entries for row in draws.values(entry))
    return BuiltPlant(plant_of(robot, effects), model, chain, sensors, values)


@dataclass(frozen=True, eq=False)
class _Draws:
    """Random sizes of the entries of a plant."""

    spec: ExperimentSpec
    loaded: LoadedRobot
    robot: RobotModel

    def plugins(
        self, entries: tuple[PlantEntry, ...]
    ) -> tuple[list[Any], list[np.random.Generator]]:
        """The plug-in of each entry with its sizes drawn, and its own generator."""
        seeds = [plant_seed(self.spec, *entry.channel) for entry in entries]
        return [self._plugin(entry) for entry in entries], list(map(np.random.default_rng, seeds))

    def values(self, entry: PlantEntry) -> Iterator[Row]:
        """The drawn sizes of an entry in SI units, by joint or as one number."""
        make = self.loaded.plugin_of(entry.kind, entry.spec)
        for key, sizes in self._sizes(entry, make).items():
            names = _joint_names(entry, make, self.robot)
            size = dict(zip(names, sizes, strict=True)) if isinstance(sizes, list) else sizes
            use = entry.spec["use"]
            yield {"group": entry.group, "use": use, "setting": key, "drawn": size}

    def _plugin(self, entry: PlantEntry) -> Any:
        make = self.loaded.plugin_of(entry.kind, entry.spec)
        fields, drawn = plugin_fields(make), dict[str, Any]()
        sizes_of_all = {**self._numbers(entry, make), **self._sizes(entry, make)}
        for key, sizes in sizes_of_all.items():
            # A plug-in reads a bare number in the unit of the setting, which may be "%".
            scale = quantity(1.0, (fields[key].unit if key in fields else None) or "1")
            drawn[key] = (np.array(sizes) / scale).tolist()
        return self.loaded.build_plugin(entry.kind, {**entry.spec, **drawn})

    def _sizes(self, entry: PlantEntry, make: Any) -> Mapping[str, list[float] | float]:
        fields, sizes = plugin_fields(make), dict[str, list[float] | float]()
        for key, limits in check_limits(entry, make).items():
            rng = np.random.default_rng(plant_seed(self.spec, *entry.channel, key))
            listed = key in fields and fields[key].is_per_joint
            lengths = self._lengths(entry, make, key) if listed else np.ones(1)
            values = (random_size(limits, len(lengths), rng) * lengths).tolist()
            sizes[key] = values if listed else values[0]
        return sizes

    def _numbers(self, entry: PlantEntry, make: Any) -> dict[str, list[float]]:
        """Angles that hold for all joints, and defaults of this kind, with their lengths on
        slides."""
        settings = dataclasses.fields(make) if dataclasses.is_dataclass(make) else ()
        default = {field.name: field.default for field in settings}
        numbers = {}
        for key, field in plugin_fields(make).items():
            written = entry.spec.get(key, default[key])
            if field.unit != ANGLE or not field.is_per_joint or is_random(written):
                continue
            lengths = self._lengths(entry, make, key, written)
            if (lengths != 1.0).any():
                numbers[key] = (quantity(written, ANGLE) * lengths).tolist()
        return numbers

    def _lengths(self, entry: PlantEntry, make: Any, key: str, written: Any = None) -> Array:
        """SLIDE (m/rad) for each slide of a composed plant whose size is written as an angle, and
        1 for every other joint."""
        names = _joint_names(entry, make, self.robot)
        composed = self.spec.plant.get("use") == COMPOSED
        if not (composed and plugin_fields(make)[key].unit == ANGLE):
            return np.ones(len(names))
        angle = is_rotation(entry.spec[key] if written is None else written)
        slides = {joint.dofs[0] for joint in self.robot.joints if joint.kind == "slide"}
        return np.array([SLIDE if angle and name in slides else 1.0 for name in names])


def _joint_names(entry: PlantEntry, make: Any, robot: RobotModel) -> tuple[str, ...]:
    """Names of the joints that lists of sizes are for: those that its `size_names` gives, else
    the measured ones for sensors, all degrees of freedom for effects and all joints for errors."""
    size_names = getattr(make, "size_names", None)
    if size_names is not None:
        return tuple(size_names(robot))
    if entry.group == "errors":
        return tuple(joint.name for joint in robot.joints)
    return robot.rows if entry.group == "effects" else robot.torque_rows


Move = Callable[[Array], tuple[Oracle, Controller | None]]
"""Encoder errors (N, n) -> ground truth of the plant that moves with them, and its controller."""


@dataclass(frozen=True, eq=False)
class EncoderModel:
    """Encoders of the model's joints: white noise and rounding, and the errors of the chain."""

    built: BuiltPlant
    noise: Noise
    draws: NoiseSamples

    @property
    def has_position_error(self) -> bool:
        """True where the errors are known only with the motion."""
        return self.noise.quantum > 0 or self.built.chain.has(EncoderStage)

    def error(self, motion: Trajectory | None = None, every: int = 1) -> Array:
        """The errors (N, n) on a motion of every `every`-th step; None: those of any motion."""
        draws = replace(self.draws, encoder=self.draws.encoder[::every])
        if motion is None or not self.has_position_error:
            return position_error(self.noise, draws)
        robot, chain = self.built.model, self.built.chain
        q = _independent_positions(robot, motion)
        scalar = np.flatnonzero(np.isin(robot.torque_dofs, robot.scalar_dofs))
        repeated = chain.encoder_error(q) if chain.has(EncoderStage) else None
        return position_error(self.noise, draws, q, scalar, repeated)


@dataclass(frozen=True, eq=False)
class _EncoderRun:
    """A run whose loop saw the errors (N, n) of its encoders: the plant's ground truth `oracle`,
    the same as the model counts it (`seen`), and the controller."""

    encoders: EncoderModel
    oracle: Oracle
    seen: Oracle
    controller: Controller | None
    error: Array

    def read(self, rng_of: RngOf, every: int) -> "SampledSignals":
        """The signals of every `every`-th step after the transducers and the sampling."""
        built, signals = self.encoders.built, self.seen
        if built.chain.has(TorqueStage):
            q = _independent_positions(built.model, signals.motion)
            rms = np.sqrt((signals.tau**2).mean(axis=0))
            exact = TorqueSignal(signals.motion.t, q, signals.tau, rms)
            signals = replace(signals, tau=built.chain.torque_reading(exact, rng_of))
        if not built.chain.has(SamplingStage):
            return SampledSignals(signals, self.error, every)
        joints = len(built.model.torque_dofs)
        late_q, late_tau = built.chain.sampling_delay(signals.motion.t[::every], joints, rng_of)
        late = sampled_with_delay(built.model, signals, every, late_q, late_tau)
        # Encoders are read late, and then rounded: readings stay on their grid.
        return SampledSignals(late, self.encoders.error(late.motion, every), 1)


@dataclass(frozen=True, eq=False)
class SampledSignals:
    """Motion and torque as sampled, and the errors (N, n) of encoders; every `stride`-th of them
    is recorded."""

    signals: Oracle
    error: Array
    stride: int


def run_with_encoder_errors(encoders: EncoderModel, move: Move) -> _EncoderRun:
    """Move the plant with a loop that sees the errors of its encoders."""
    error = encoders.error()

    def seen_by_model(oracle: Oracle) -> Oracle:
        return encoders.built.coordinates.to_model(
            replace(oracle, motion=oracle.measured, encoders=None)
        )

    oracle, controller = move(error)
    if encoders.has_position_error:
        # The first run gives positions, the second one runs with the loop seeing their errors. The
        # recorded errors are those of its own positions, so that readings lie on the encoder's
        # grid.
        oracle, controller = move(encoders.error(seen_by_model(oracle).motion))
        error = encoders.error(seen_by_model(oracle).motion)
    return _EncoderRun(encoders, oracle, seen_by_model(oracle), controller, error)


def _independent_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Positions (N, n) of the joints with measured torque; zero for balls and free joints."""
    q: Array = joint_positions(robot, motion)[:, robot.torque_dofs]
    return q


@dataclass(frozen=True, eq=False)
class MeasuredSensors:
    """The sensors of a task on the moving plant. Without any, recordings are left as they are."""

    spec: ExperimentSpec
    built: BuiltPlant
    task: Task
    run: int = 0  # other runs of the same sensor have other noise

    def recording(self, raw: Recording, oracle: Oracle, decimation: int) -> Recording:
        """The recording `raw` of every `decimation`-th step of the plant's motion, with the
        readings of the sensors.

        Raises UnsupportedError for a contact in a simulation that does not feel it.
        """
        if not self.task.cuts:
            return raw
        # A stream of its own: a sensor leaves the noise of torques and encoders as it is.
        white = np.random.default_rng(seed_of(noise_seed(self.spec), "wrench", self.run))
        noise = wrench_noise(self.spec.noise)
        motion = sampled_motion(oracle.motion, decimation)
        contact = self._contact(motion)
        if contact is not None:
            # The motors hold the robot on its motion against the contact.
            plant = self.built.plant
            tau = plant.robot.reduced(motion.q, contact_torque(plant, contact, motion))
            raw = replace(raw, tau=raw.tau - self.built.coordinates.torque_to_model(tau))
        errors = _sensor_errors(self.spec, len(self.task.cuts))
        exact = np.split(self._wrench(motion, contact), len(errors), axis=1)
        parts = [
            error.read(wrench, raw.t) + noise.white() * white.normal(size=wrench.shape)
            for error, wrench in zip(errors, exact, strict=True)
        ]
        rows = tuple(row for cut in self.task.cuts for row in cut.rows)
        return replace(raw, wrench=np.hstack(parts), wrench_rows=rows)

    def noise_free(self, oracle: Oracle) -> tuple[Trajectory, Array]:
        """The plant's motion as the model counts it, and the noise-free torques and wrenches (N,
        nv + 6 sensors), with the constant offsets of the sensors where those are among the
        unknowns."""
        seen = self.built.coordinates.to_model(oracle)
        if not self.task.cuts:
            return seen.motion, seen.tau
        wrench = self._wrench(oracle.motion)
        # Constant offsets are unknowns of a task that has more than ten parameters for each body.
        alone = self.task.definition.measures_sensor_only
        if alone and len(self.task.parameters) > 10 * len(self.task.bodies):
            wrench += self.task.truth.theta[10 * len(self.task.bodies) :]
        return seen.motion, np.hstack([seen.tau, wrench])

    def _wrench(self, motion: Trajectory, contact: Contact | None = None) -> Array:
        return sensor_wrench(self.built.plant, self.task.cuts, motion, contact)

    def _contact(self, motion: Trajectory) -> Contact | None:
        """A contact on the last body during the middle third of a motion."""
        force = wrench_noise(self.spec.noise).touch
        if force == 0.0:
            return None
        if self.spec.simulation["use"] != "inverse":
            raise UnsupportedError(
                "A contact (noise.touch) needs the simulation 'inverse': it moves no robot."
            )
        rng = np.random.default_rng(seed_of(noise_seed(self.spec), "touched", self.run))
        wrench, part = random_wrench(motion, force, rng), len(motion) // 3
        wrench[:part] = wrench[2 * part :] = 0.0
        return Contact(end_body(self.built.plant.robot, self.task.cuts[0]), wrench)


def sensor_offset(spec: ExperimentSpec, count: int) -> Array:
    """True offsets (6 count,) [n; f] of the measured sensor and of those that end its sub-tree."""
    return np.concatenate([error.offset for error in _sensor_errors(spec, count)])


def _sensor_errors(spec: ExperimentSpec, count: int) -> list[SensorError]:
    """Offset, drift, gain, crosstalk and mounting errors of each sensor of an experiment."""
    rng, noise = np.random.default_rng(sensor_seed(spec)), wrench_noise(spec.noise)
    return [sensor_error(noise, rng) for _ in range(count)]
