"""The part of a simulated experiment that noise does not touch, shared by levels and repeats."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from sysid_bench.canonical_json import canonical
from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import TorqueModel, information_model
from sysid_bench.experiments.loaded_robot import LoadedRobot
from sysid_bench.experiments.processed_rows import sampled_motion
from sysid_bench.experiments.simulated.built_plant import (
    MeasuredSensors,
    built_plant,
    sensor_offset,
)
from sysid_bench.experiments.simulated.problem import ProblemBuilder, term_torque
from sysid_bench.experiments.simulated.record import SimulatedRobot, held_out_motions
from sysid_bench.experiments.spec import PLANT, REDRAWN, ExperimentSpec, known_seed, prior_seed
from sysid_bench.experiments.tasks.prior import PriorSpread, prior_of, with_known_errors
from sysid_bench.experiments.tasks.task import Task, TaskDefinition, find_task
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import instruments_of
from sysid_bench.models.shape import body_extents
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.sensor_offset import measured_regression
from sysid_bench.signals.row_processing import MOVING
from sysid_bench.simulation.candidate import Candidate, KnownModel, kinematics_of, plant_of_model
from sysid_bench.types import (
    Array,
    BaseMap,
    BodyExtents,
    Controller,
    Oracle,
    Prior,
    Problem,
    Recording,
    Trajectory,
)


@dataclass(frozen=True, eq=False)
class KnownTorque:
    """Torque (N, rows) of the known parts of a task along any motion."""

    model: KnownModel
    rows: tuple[int, ...]

    @cached_property
    def _parts(self) -> tuple[bool, dict[str, Array], Array | None]:
        """Parts of links, joint terms and viscous coupling other than zero: filters ask at every
        step."""
        model = self.model
        terms = {name: values for name, values in model.known_terms.items() if values.any()}
        coupling = model.known_coupling if model.known_coupling.any() else None
        return bool(model.known_links.any()), terms, coupling

    def __call__(self, motion: Trajectory) -> Array:
        model = self.model
        links, terms, coupling = self._parts
        if not links and not terms and coupling is None:
            return np.zeros((len(motion.a), len(self.rows)))
        tau = np.zeros_like(motion.a)
        if links:
            tau += newton_euler(model.robot.tree, model.known_links, motion)
        tau += term_torque(model.robot, terms, coupling, motion)
        return model.robot.reduced(motion.q, tau)[:, list(self.rows)]


@dataclass(frozen=True, eq=False)
class SimulatedModel:
    """The method's own model along the commanded motion, under the declared controller, or under
    one with other gains.

    Raises UnsupportedError without a controller, EstimationError for `theta` (p,) that cannot be
    simulated.
    """

    model: KnownModel
    raw: Recording
    candidate: Candidate

    def __call__(self, theta: Array, controller: Controller | None = None) -> Recording:
        controller, commanded = controller or self.raw.controller, self.raw.commanded
        if controller is None or commanded is None:
            raise UnsupportedError(
                "This recording declares no controller: nothing to simulate with."
            )
        theta = np.asarray(theta, dtype=float)
        names = self.model.parameters
        if theta.shape != (len(names),):
            raise EstimationError(f"theta has the shape {theta.shape}; expected ({len(names)},).")
        if not np.isfinite(theta).all():
            bad = names[int(np.flatnonzero(~np.isfinite(theta))[0])]
            raise EstimationError(f"theta cannot be simulated: {bad} is not finite.")
        plant = self.candidate.plant(plant_of_model(self.model, theta))
        oracle = self.candidate.control(controller.rate).follow(
            plant, controller, commanded, np.zeros((len(commanded), len(controller.kp)))
        )
        # The loop runs at the rate of the controller; its signals are sampled like the measured.
        decimation = round(controller.rate / self.raw.rate)
        motion, tau = sampled_motion(oracle.motion, decimation), oracle.tau[::decimation]
        return replace(self.raw, t=motion.t, q=motion.q, v=motion.v, a=motion.a, tau=tau)


def known_model(robot: RobotModel, task: Task) -> KnownModel:
    """The robot without its unknown parameters: kinematics, and the parts that the task knows."""
    coupling = task.known_coupling
    return KnownModel(
        kinematics_of(robot), task.parameters, task.bodies, task.known_links, task.known_terms,
        np.zeros((robot.nv, robot.nv)) if coupling is None else coupling,
    )  # fmt: skip


def check_simulation(*_: Any) -> Any:
    """Raise UnsupportedError: a closed loop needs more of the robot than the sensors see."""
    raise UnsupportedError(
        "A task with force/torque sensors declares no whole robot: nothing to simulate with."
    )


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
        return {
            name: self.builder.build(*self.exact(oracle)) for name, oracle in self._oracles.items()
        }

    @cached_property
    def held_out_moving(self) -> dict[str, Problem]:
        """The same problems without the rows of joints at standstill."""
        problems = {}
        for name, oracle in self._oracles.items():
            motion, measured = self.exact(oracle)
            rows = self.builder.rows_along(motion, MOVING)
            problems[name] = self.builder.build(motion, measured, rows=rows)
        return problems

    @cached_property
    def _oracles(self) -> dict[str, Oracle]:
        return held_out_motions(self.spec, self.simulated)

    def exact(self, oracle: Oracle) -> tuple[Trajectory, Array]:
        """Motion as the model counts it, and noise-free torques and wrenches (N, n + 6 sensors)."""
        return MeasuredSensors(self.spec, self.simulated.built, self.task).noise_free(oracle)


def noise_free_part(spec: ExperimentSpec, loaded: LoadedRobot) -> NoiseFreePart:
    """The noise-free part of a specification, made once for all specifications that share it."""
    return _shared_part(canonical(_without_noise(spec, loaded).to_json()), loaded)


def _without_noise(spec: ExperimentSpec, loaded: LoadedRobot) -> ExperimentSpec:
    """The fields of a specification that its noise-free part depends on.

    The constants of a force/torque sensor are among its errors, and are unknowns of a sensor task:
    there nothing can be left out.
    """
    if find_task(spec.task, loaded.folder).measures_sensor_only:
        return spec
    redrawn = PLANT in spec.redrawn or (not isinstance(spec.prior, str) and spec.prior.get(REDRAWN))
    repeat = spec.repeat if redrawn else 0
    return replace(spec, noise={}, signals={}, pipeline=None, repeat=repeat)


@lru_cache(maxsize=2)
def _shared_part(text: str, loaded: LoadedRobot) -> NoiseFreePart:
    """The noise-free part of a specification given as canonical JSON, which hashes."""
    spec, robot = ExperimentSpec.from_json(json.loads(text)), loaded.robot
    definition = find_task(spec.task, loaded.folder)
    terms = unknown_terms(spec, robot, definition)
    exact_task = definition.unknowns(robot, terms, spec.sensor, partial(sensor_offset, spec))
    share = 0.0 if isinstance(spec.prior, str) else spec.prior.get("known", 0.0)
    task = exact_task
    if share != 0.0:  # the known parts have errors, too
        task = with_known_errors(task, share, np.random.default_rng(known_seed(spec)))
    # Base parameters depend on structure alone: no motion, noise or true value is involved.
    base = loaded.base_map(task.parameters, task.rows, task.cuts)
    instruments = instruments_of(robot, task.cuts)
    regression = measured_regression(robot, base.names, instruments, task.rows)
    builder = ProblemBuilder(robot, task, base, regression)
    built = built_plant(spec, loaded, robot)
    prior = _prior(spec, task)
    design = partial(_design_problem, robot, task, base, prior)
    return NoiseFreePart(spec, task, builder, SimulatedRobot(spec, loaded, built, design), prior)


def unknown_terms(spec: ExperimentSpec, robot: RobotModel, task: TaskDefinition) -> tuple[str, ...]:
    """The joint terms that are identified: those of `spec`, else the defaults of the task."""
    return task.default_terms(robot) if spec.terms is None else spec.terms


def _design_problem(
    robot: RobotModel, task: Task, base: BaseMap, prior: Prior | None, rate: float
) -> DesignProblem:
    """Inputs of excitation design at `rate` (Hz): limits, regressor, and torques by the prior."""
    # A task with sensors has no prior of the bodies before them: torques cannot be predicted.
    torque = None if prior is None or task.cuts else _torque_model(robot, task, prior)
    information = information_model(robot, base.names, task.rows, task.cuts)
    scene = partial(collision_model, robot)
    return replace(design_problem(robot, rate), regress=information, torque=torque, scene=scene)


def _torque_model(robot: RobotModel, task: Task, prior: Prior) -> TorqueModel:
    """Torque by the prior parameters and the known parts, for limits of torque."""
    # Designs hold ball and free joints, whose terms have no columns.
    terms = {
        f"{robot.rows[dof]}.{SUFFIX[term]}": float(values[dof])
        for term, values in task.known_terms.items()
        for dof in robot.scalar_dofs
        if values[dof]
    }
    regression = torque_regression(robot, (*task.parameters, *terms))
    theta = np.array([*prior.theta, *terms.values()])
    return TorqueModel(regression, theta, task.known_links, robot.tree, robot.coupling)


def _prior(spec: ExperimentSpec, task: Task) -> Prior | None:
    """The prior of the unknowns: drawn around the truth, the truth itself, or None."""
    if spec.prior == "none":
        return None
    spread = None
    if not isinstance(spec.prior, str):
        own = {k: x for k, x in spec.prior.items() if k not in (REDRAWN, "known")}
        spread = PriorSpread(**own)
    return prior_of(task, spread, np.random.default_rng(prior_seed(spec)))
