"""The plant of an experiment, the identified model beside it, and the sensor chain between them."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.simulated.composed_plant import (
    COMPOSED,
    PlantEntry,
    composed_plant,
    random_limits,
)
from sysid_bench.experiments.spec import SEALED, ExperimentSpec, plant_seed, seed_of
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import plugin_fields
from sysid_bench.simulation.model_errors import PlantCoordinates
from sysid_bench.simulation.plant import Plant, coupling_law, plant_of
from sysid_bench.simulation.sensors import RngOf, SensorChain
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
    channels: tuple[tuple[Any, ...], ...]  # of the seeds of the stages of `chain`
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
        return lambda stage: np.random.default_rng(seed_of(seed, *self.channels[stage]))


def built_plant(spec: ExperimentSpec, loaded: LoadedRobot, model: RobotModel) -> BuiltPlant:
    """The plant of a specification around `model`, whose errors are the same for all payloads; the
    inertias of a sealed one are those of `model`, not of its file.

    Raises UsageError for sizes that do not fit the robot.
    """
    effects: list[Any] = []
    stages: list[Any] = []
    values: list[Row] = []
    channels, robot = [], model
    for entry in composed_plant(spec.plant):
        plugin, drawn = _drawn_plugin(spec, loaded, model, entry)
        rng = np.random.default_rng(plant_seed(spec, *entry.channel))
        values += drawn
        if entry.group == "errors":
            robot = plugin.apply(robot, rng)
        elif entry.group == "sensors":
            stages.append(plugin.prepare(model, rng))
            channels.append(entry.channel)
        else:
            effects.append(plugin)
    chain = SensorChain(tuple(stages))
    plant = plant_of(robot, effects)
    if spec.plant.get(SEALED):
        plant = dataclasses.replace(plant, phi=robot.phi)
    return BuiltPlant(plant, model, chain, tuple(channels), tuple(values))


def _drawn_plugin(
    spec: ExperimentSpec, loaded: LoadedRobot, robot: RobotModel, entry: PlantEntry
) -> tuple[Any, list[Row]]:
    """The plug-in of an entry with its random sizes drawn, and these in SI units as rows, by joint
    or as one number."""
    make = loaded.plugin_of(entry.kind, entry.spec)
    fields, names = plugin_fields(make), _joint_names(entry, make, robot)
    defaults = {field.name: field.default for field in dataclasses.fields(make)} if fields else {}
    is_composed = spec.plant.get("use") == COMPOSED

    def lengths(key: str, written: Any) -> Array:
        is_angle = is_composed and fields[key].unit == ANGLE and is_rotation(written)
        return _slide_lengths(robot, names) if is_angle else np.ones(len(names))

    sizes: dict[str, Array | float] = {}
    # Angles that hold for all joints, defaults among them, are lengths on slides.
    for key, field in fields.items():
        written = entry.spec.get(key, defaults[key])
        if field.unit == ANGLE and field.is_per_joint and not is_random(written):
            by_joint = lengths(key, written)
            if (by_joint != 1.0).any():
                sizes[key] = quantity(written, ANGLE) * by_joint
    rows: list[Row] = []
    for key, limits in random_limits(entry, make).items():
        rng = np.random.default_rng(plant_seed(spec, *entry.channel, key))
        shown: Any
        if key in fields and fields[key].is_per_joint:
            size = random_size(limits, len(names), rng) * lengths(key, entry.spec[key])
            sizes[key], shown = size, dict(zip(names, size.tolist(), strict=True))
        else:
            sizes[key] = shown = float(random_size(limits, 1, rng)[0])
        rows.append(
            {"group": entry.group, "use": entry.spec["use"], "setting": key, "drawn": shown}
        )
    drawn = {}
    for key, x in sizes.items():
        # A plug-in reads a bare number in the unit of the setting, which may be "%".
        scale = quantity(1.0, (fields[key].unit if key in fields else None) or "1")
        drawn[key] = (np.asarray(x) / scale).tolist()
    return loaded.build_plugin(entry.kind, {**entry.spec, **drawn}), rows


def _slide_lengths(robot: RobotModel, names: Sequence[str]) -> Array:
    """SLIDE (m/rad), which makes a length of an angle, for each slide and 1 for other joints."""
    slides = {joint.dofs[0] for joint in robot.joints if joint.kind == "slide"}
    return np.array([SLIDE if name in slides else 1.0 for name in names])


def _joint_names(entry: PlantEntry, make: Any, robot: RobotModel) -> Sequence[str]:
    """Names of the joints that lists of sizes are for: those that its `size_names` gives, else
    the measured ones for sensors, all degrees of freedom for effects and all joints for errors."""
    size_names = getattr(make, "size_names", None)
    if size_names is not None:
        return tuple(size_names(robot))
    if entry.group == "errors":
        return [joint.name for joint in robot.joints]
    return robot.rows if entry.group == "effects" else robot.torque_rows
