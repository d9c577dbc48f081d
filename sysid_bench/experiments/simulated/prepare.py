"""One experiment made ready: simulated once, its regressor reduced once, for all its estimators."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from sysid_bench.canonical_json import canonical
from sysid_bench.evaluation.score import data_figures
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.geometry import collision_model
from sysid_bench.excitation.information import TorqueModel, information_model
from sysid_bench.experiments.robot_cache import LoadedRobot
from sysid_bench.experiments.simulated.ft_sensors import SensorMeasurement, true_offset
from sysid_bench.experiments.simulated.method_model import (
    KnownTorque,
    SimulateModel,
    known_model,
    refuse_simulation,
)
from sysid_bench.experiments.simulated.preprocess import (
    apply_calibration,
    estimate_calibration,
    remove_contact,
)
from sysid_bench.experiments.simulated.problem import (
    ProblemBuilder,
    measured_signals,
    regressor_blocks,
)
from sysid_bench.experiments.simulated.record import (
    Repetition,
    SimulatedRobot,
    held_out_motions,
    record,
    repetitions,
)
from sysid_bench.experiments.spec import (
    REDRAWN,
    ExperimentSpec,
    known_seed,
    noise_seed,
    prior_seed,
)
from sysid_bench.models.bounding_boxes import body_extents
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import instruments_of
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.nested_sensors import measured_regression
from sysid_bench.simulation.parametrised_plant import KnownModel
from sysid_bench.simulation.plant import plant_of
from sysid_bench.tasks.prior import PriorSpread, prior_of, with_known_errors
from sysid_bench.tasks.task import Task, TaskDefinition, named_task
from sysid_bench.types import (
    Array,
    BaseMap,
    Experiment,
    Extent,
    Prior,
    Problem,
    Run,
    Truth,
)


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything about one experiment. Methods get `problem` and `experiment`; `held_out`, posed
    with exact signals, and `truth` are for scoring."""

    robot: RobotModel
    task: Task
    problem: Problem
    experiment: Experiment
    held_out: dict[str, Problem]
    truth: Truth
    known: Array  # (N, rows) torque of what the task takes as known, along the measured motion
    bound: Array | None  # (r,) Cramer-Rao, as standard deviations, where torque alone is noisy
    noisy: bool
    left_out: float  # share of the samples that are taken for contacts
    stage: "NoiseFreePart"

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Rank and conditioning of the data: one and the same for all estimators."""
        return data_figures(self.problem, self.held_out) | {"left_out": self.left_out}

    @property
    def extents(self) -> Mapping[str, Extent]:
        """How far each body reaches."""
        return self.stage.extents


def prepare(spec: ExperimentSpec, subject: LoadedRobot) -> Prepared:
    """The experiment of a specification; raises UnsupportedError or UsageError with the reason."""
    stage = _stage(canonical(_noise_free(spec, subject).to_json()), subject)
    task, posing, plant = stage.task, stage.builder, stage.simulated.plant
    turns = repetitions(spec, task)
    main = next(turn for turn in turns if turn.loaded)
    taken = record(spec, stage.simulated, SensorMeasurement(spec, plant, task), main)
    raw, recording = taken.raw, taken.recording
    if "calibration" in spec.signals and task.cuts:
        calibration = estimate_calibration(spec, subject, task)
        raw, recording = (
            apply_calibration(raw, calibration),
            apply_calibration(recording, calibration),
        )
    recording, left_out = remove_contact(spec.signals.get("contacts"), recording, posing)
    problem = posing.build(recording.motion, measured_signals(recording), stage.prior)
    regress = partial(regressor_blocks, posing.regression, posing.row_indices, posing.instruments)
    simulate = refuse_simulation if task.cuts else SimulateModel(stage.known_model, raw)
    known = refuse_simulation if task.cuts else KnownTorque(stage.known_model, posing.row_indices)
    runs = _runs(spec, stage, turns, Run(True, recording))
    experiment = Experiment(problem, recording, raw, regress, simulate, known, runs)
    make_read_only(experiment)
    return Prepared(
        subject.robot, task, problem, experiment, stage.held_out, task.truth,
        posing.known(recording.motion)[:, posing.row_indices], taken.cramer_rao_bound(posing),
        bool(spec.noise), left_out, stage,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class NoiseFreePart:
    """All of an experiment that its noise does not touch: levels and repeats share it."""

    spec: ExperimentSpec
    task: Task
    builder: "ProblemBuilder"
    simulated: "SimulatedRobot"
    prior: Prior | None

    @cached_property
    def known_model(self) -> KnownModel:
        """The robot as methods may know it."""
        return known_model(self.builder.robot, self.task)

    @cached_property
    def extents(self) -> Mapping[str, Extent]:
        """How far each body reaches."""
        return body_extents(self.builder.robot)

    @cached_property
    def held_out(self) -> dict[str, Problem]:
        """Other motions, posed with exact signals."""
        sensing = SensorMeasurement(self.spec, self.simulated.plant, self.task)
        return {
            name: self.builder.build(oracle.motion, sensing.exact(oracle))
            for name, oracle in held_out_motions(self.spec, self.simulated).items()
        }


def _noise_free(spec: ExperimentSpec, subject: LoadedRobot) -> ExperimentSpec:
    """What of a specification its stage hangs on. How a force/torque sensor was made is a part of
    the noise, and of what such a task asks for."""
    if named_task(spec.task, subject.folder).measures_sensor_only:
        return spec
    redrawn = not isinstance(spec.prior, str) and spec.prior.get(REDRAWN)
    return replace(spec, noise={}, signals={}, repeat=spec.repeat if redrawn else 0)


@lru_cache(maxsize=2)
def _stage(text: str, subject: LoadedRobot) -> NoiseFreePart:
    """The stage of a specification, as canonical JSON."""
    spec, robot = ExperimentSpec.from_json(json.loads(text)), subject.robot
    definition = named_task(spec.task, subject.folder)
    terms = identified_terms(spec, robot, definition)
    task = task_for_methods(
        spec, definition.unknowns(robot, terms, spec.sensor, partial(true_offset, spec))
    )
    base = subject.base_map(task.parameters, task.rows, task.cuts)
    instruments = instruments_of(robot, task.cuts)
    columns = measured_regression(robot, base.names, instruments, task.rows)
    posing = ProblemBuilder(robot, task, base, columns)
    plant = plant_of(robot, [subject.build_plugin("plant", spec.plant)])
    prior = _prior(spec, task)
    take = SimulatedRobot(spec, subject, plant, partial(_brief, robot, task, base, prior))
    return NoiseFreePart(spec, task, posing, take, prior)


def identified_terms(
    spec: ExperimentSpec, robot: RobotModel, task: TaskDefinition
) -> tuple[str, ...]:
    """The joint terms that are identified; by default those of the task."""
    return task.default_terms(robot) if spec.terms is None else spec.terms


def task_for_methods(spec: ExperimentSpec, task: Task) -> Task:
    """The task as methods are told it: its known parts with errors where the prior says so."""
    share = 0.0 if isinstance(spec.prior, str) else spec.prior.get("known", 0.0)
    if share == 0.0:
        return task
    return with_known_errors(task, share, np.random.default_rng(known_seed(spec)))


def make_read_only(value: Any) -> None:
    """Makes the arrays of a noun read-only: the estimators of one experiment share them."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, partial):
        make_read_only(value.args)
    elif isinstance(value, tuple):
        for part in value:
            make_read_only(part)
    elif is_dataclass(value) and type(value).__module__ == Problem.__module__:
        for field in fields(value):
            make_read_only(getattr(value, field.name))


def _brief(
    robot: RobotModel, task: Task, base: BaseMap, prior: Prior | None, rate: float
) -> DesignProblem:
    """What a designer of motions is told: limits, the question, and torques by the prior alone."""
    brief = design_problem(robot, rate)
    terms = {  # ball and free joints, whose terms have no columns, are held by designs
        f"{robot.rows[dof]}.{SUFFIX[term]}": float(values[dof])
        for term, values in task.known_terms.items()
        for dof in robot.scalar_dofs
        if values[dof]
    }
    torque = None
    if prior is not None and not task.cuts:  # behind a sensor nothing is told of the rest
        columns = torque_regression(robot, (*task.parameters, *terms))
        theta = np.array([*prior.theta, *terms.values()])
        torque = TorqueModel(columns, theta, task.known_links, robot.tree, robot.coupling)
    asked = information_model(robot, base.names, task.rows, task.cuts)
    return replace(brief, regress=asked, torque=torque, scene=partial(collision_model, robot))


def _runs(
    spec: ExperimentSpec, stage: NoiseFreePart, turns: tuple[Repetition, ...], main: Run
) -> tuple[Run, ...]:
    """All recordings of the commanded motion, `main` among them; none where it is the only one."""
    if len(turns) == 1:
        return ()
    loaded = stage.simulated
    robot = load_robot(loaded.loaded.robot.manifest, parse_payload("none"), spec.free_base)
    plant = plant_of(robot, [loaded.loaded.build_plugin("plant", spec.plant)])
    takes = {True: loaded, False: replace(loaded, plant=plant)}
    runs = []
    for turn in turns:
        if turn.seed == noise_seed(spec):
            runs.append(main)
            continue
        take = takes[turn.loaded]
        taken = record(spec, take, SensorMeasurement(spec, take.plant, stage.task), turn)
        runs.append(Run(turn.loaded, taken.recording))
    return tuple(runs)


def _prior(spec: ExperimentSpec, task: Task) -> Prior | None:
    if spec.prior == "none":
        return None
    spread = None
    if not isinstance(spec.prior, str):
        unknown = {k: far for k, far in spec.prior.items() if k not in (REDRAWN, "known")}
        spread = PriorSpread(**unknown)
    return prior_of(task, spread, np.random.default_rng(prior_seed(spec)))
