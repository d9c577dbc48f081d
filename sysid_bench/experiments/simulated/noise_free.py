"""The part of a simulated experiment that noise does not touch, shared by levels and repeats."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from sysid_bench.canonical_json import canonical
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import TorqueModel, information_model
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.simulated.built_plant import built_plant
from sysid_bench.experiments.simulated.problem import ProblemBuilder, known_model
from sysid_bench.experiments.simulated.record import SimulatedRobot, sensor_offset
from sysid_bench.experiments.simulated.sealed_robot import file_prior, robot_of_plant, stated_spread
from sysid_bench.experiments.spec import (
    PLANT,
    REDRAWN,
    SEALED,
    ExperimentSpec,
    known_seed,
    prior_seed,
)
from sysid_bench.experiments.tasks.prior import PriorSpread, prior_of, with_known_errors
from sysid_bench.experiments.tasks.task import Task, TaskDefinition, find_task
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import instruments_of
from sysid_bench.models.shape import body_extents
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.sensor_offset import measured_regression
from sysid_bench.signals.row_processing import MOVING
from sysid_bench.simulation.candidate import KnownModel
from sysid_bench.types import BaseMap, BodyExtents, Prior, Problem


@dataclass(frozen=True, eq=False)
class NoiseFreePart:
    """Task, plant, prior and held-out motions of an experiment.

    The task, its truth and prior, the regressors and the motions are those of the identified model;
    what moves is the plant (`simulated.built`), which may have another geometry.
    """

    spec: ExperimentSpec
    task: Task
    builder: ProblemBuilder
    simulated: SimulatedRobot
    prior: Prior | None

    @cached_property
    def simulated_motions(self) -> tuple[SimulatedRobot, ...]:
        """The plant on each of the training motions."""
        further = (replace(self.simulated, motion=i) for i in range(1, self.spec.motions))
        return (self.simulated, *further)

    @cached_property
    def known_model(self) -> KnownModel:
        """The robot without its unknown parameters."""
        return known_model(self.builder.robot, self.task)

    @cached_property
    def extents(self) -> Mapping[str, BodyExtents]:
        """Extent of each body, by name."""
        return body_extents(self.builder.robot)

    @cached_property
    def held_out(self) -> dict[str, Problem]:
        """Problems of other motions, with exact signals."""
        oracles = self.simulated.held_out.items()
        return {
            name: self.builder.build(*self.simulated.noise_free(oracle)) for name, oracle in oracles
        }

    @cached_property
    def held_out_moving(self) -> dict[str, Problem]:
        """The same problems without the rows of joints at standstill."""
        problems = {}
        for name, oracle in self.simulated.held_out.items():
            motion, measured = self.simulated.noise_free(oracle)
            rows = self.builder.rows_along(motion, MOVING)
            problems[name] = self.builder.build(motion, measured, rows=rows)
        return problems


def noise_free_part(spec: ExperimentSpec, loaded: LoadedRobot) -> NoiseFreePart:
    """The noise-free part of a specification, made once for all specifications that share it."""
    # The constants of a force/torque sensor are among its errors, and are unknowns of a sensor
    # task: there nothing can be left out.
    if not find_task(spec.task, loaded.folder).measures_sensor_only:
        random_prior = not isinstance(spec.prior, str) and spec.prior.get(REDRAWN)
        repeat = spec.repeat if PLANT in spec.redrawn or random_prior else 0
        spec = replace(spec, noise={}, signals={}, pipeline=None, repeat=repeat)
    return _shared_part(canonical(spec.to_json()), loaded)


@lru_cache(maxsize=2)
def _shared_part(text: str, loaded: LoadedRobot) -> NoiseFreePart:
    """The noise-free part of a specification given as canonical JSON, which hashes."""
    spec, robot = ExperimentSpec.from_json(json.loads(text)), loaded.robot
    definition = find_task(spec.task, loaded.folder)
    terms = unknown_terms(spec, robot, definition)
    offset = partial(sensor_offset, spec)
    of_file = definition.unknowns(robot, terms, spec.sensor, offset)
    task = of_file
    if spec.plant.get(SEALED):
        robot = robot_of_plant(spec, robot, of_file.parameters)
        task = definition.unknowns(robot, terms, spec.sensor, offset)
    written = {} if isinstance(spec.prior, str) else dict(spec.prior)
    share = written.pop("known", 0.0)
    if share != 0.0:  # the known parts have errors, too
        task = with_known_errors(task, share, np.random.default_rng(known_seed(spec)))
    # Base parameters depend on structure alone: no motion, noise or true value is involved.
    base = loaded.base_map(task.parameters, task.rows, task.cuts)
    instruments = instruments_of(robot, task.cuts)
    regression = measured_regression(robot, base.names, instruments, task.rows)
    builder = ProblemBuilder(robot, task, base, regression)
    built, prior = built_plant(spec, loaded, robot), None
    if spec.prior != "none":  # drawn around the truth, or the truth itself
        written.pop(REDRAWN, None)
        spread = None if isinstance(spec.prior, str) else PriorSpread(**written)
        prior = prior_of(task, spread, np.random.default_rng(prior_seed(spec)))
        if spec.plant.get(SEALED):  # the file, which everybody has
            prior = file_prior(of_file, stated_spread(spec))
    design = partial(_design_problem, robot, task, base, prior)
    simulated = SimulatedRobot(spec, loaded, built, task, design)
    return NoiseFreePart(spec, task, builder, simulated, prior)


def unknown_terms(spec: ExperimentSpec, robot: RobotModel, task: TaskDefinition) -> tuple[str, ...]:
    """The joint terms that are identified: those of `spec`, else the defaults of the task."""
    return task.default_terms(robot) if spec.terms is None else spec.terms


def _design_problem(
    robot: RobotModel, task: Task, base: BaseMap, prior: Prior | None, rate: float
) -> DesignProblem:
    """Inputs of excitation design at `rate` (Hz): limits, regressor, and torques by the prior."""
    torque = None
    # A task with sensors has no prior of the bodies before them: torques cannot be predicted.
    if prior is not None and not task.cuts:
        # Designs hold ball and free joints, whose terms have no columns.
        terms = {
            f"{robot.rows[dof]}.{SUFFIX[term]}": float(values[dof])
            for term, values in task.known_terms.items()
            for dof in robot.scalar_dofs
            if values[dof]
        }
        regression = torque_regression(robot, (*task.parameters, *terms))
        theta = np.array([*prior.theta, *terms.values()])
        torque = TorqueModel(regression, theta, task.known_links, robot.tree, robot.coupling)
    information = information_model(robot, base.names, task.rows, task.cuts)
    scene = partial(collision_model, robot)
    return replace(design_problem(robot, rate), regress=information, torque=torque, scene=scene)
