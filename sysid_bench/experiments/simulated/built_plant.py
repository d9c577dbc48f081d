"""The plant of an experiment, the identified model beside it, and the sensors between them."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.seed import plant_seed, seed_of
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    PlantEntry,
    check_limits,
    composed_plant,
)
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_settings import plugin_fields
from sysid_bench.simulation.model_errors import PlantCoordinates, with_model_errors
from sysid_bench.simulation.plant import Plant, coupling_law, plant_of
from sysid_bench.simulation.sensors import RngOf, SensorChain, sensor_chain
from sysid_bench.simulation.size import ANGLE, SLIDE, is_random, is_rotation, random_size
from sysid_bench.types import Array, Row
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
