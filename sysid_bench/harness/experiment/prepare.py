"""One experiment made ready: simulated once, its regressor reduced once, for all its estimators."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.evaluation.score import data_figures
from sysid_bench.excitation.brief import brief_of
from sysid_bench.harness.experiment.robots import Subject
from sysid_bench.harness.experiment.spec import (
    ExperimentSpec,
    held_out_seed,
    motion_seed,
    noise_seed,
    prior_seed,
)
from sysid_bench.models.prior import PriorSpread, prior_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.task import Task, task_of
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.fold import dense_blocks, fold
from sysid_bench.regressors.kernel import newton_euler
from sysid_bench.regressors.regression import TERM
from sysid_bench.signals.process import processing_of
from sysid_bench.simulation.candidate import Declared, candidate, declared
from sysid_bench.simulation.closed_loop import ClosedLoop
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.simulation.sensors import Noise, draw, encoder_error, sense
from sysid_bench.types import (
    Array,
    BaseMap,
    Experiment,
    Oracle,
    Prior,
    Problem,
    Recording,
    Trajectory,
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

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Rank and conditioning of the data: one and the same for all estimators."""
        return data_figures(self.problem, self.held_out)


def prepare(spec: ExperimentSpec, subject: Subject) -> Prepared:
    """The experiment of a specification; raises UnsupportedError or UsageError with the reason."""
    robot = subject.robot
    task = task_of(robot, spec.task, _terms(spec, robot))
    base = subject.base(task.parameters, task.rows)
    posing = Posing(robot, task, base, torque_regression(robot, base.names))
    plant = plant_of(robot, [subject.build("plant", spec.plant)])
    raw, recording = _record(spec, subject, plant)
    prior = _prior(spec, task)
    problem = posing.pose(recording.motion, recording.tau, prior)
    held_out = {
        name: posing.pose(oracle.motion, oracle.tau)
        for name, oracle in _held_out(spec, subject, plant).items()
    }
    regress = partial(regressor_blocks, posing.regression, posing.places)
    experiment = Experiment(problem, recording, raw, regress, _Simulate(declared(robot, task), raw))
    seal(experiment)
    return Prepared(
        robot, task, problem, experiment, held_out, task.truth,
        posing.known(recording.motion)[:, posing.places],
    )  # fmt: skip


def _terms(spec: ExperimentSpec, robot: RobotModel) -> tuple[str, ...]:
    """The joint terms that are identified; the robot's own are those of the task `robot`."""
    if spec.terms is not None:
        return spec.terms
    return robot.manifest.terms if spec.task == "robot" else ()


def seal(value: Any) -> None:
    """Makes the arrays of a noun read-only: the estimators of one experiment share them."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, partial):
        seal(value.args)
    elif isinstance(value, tuple):
        for part in value:
            seal(part)
    elif is_dataclass(value) and type(value).__module__ == Problem.__module__:
        for field in fields(value):
            seal(getattr(value, field.name))


@dataclass(frozen=True, eq=False)
class Posing:
    """Turns motions and torques of one robot and task into problems.

    A problem goes to methods, so it never holds this: the task knows the answer.
    """

    robot: RobotModel
    task: Task
    base: BaseMap
    regression: AnyRegression

    @property
    def places(self) -> tuple[int, ...]:
        """The rows of the robot that the task measures, as places in its `torque_rows`."""
        own = self.robot.torque_rows
        return tuple(own.index(row) for row in (own if self.task.rows is None else self.task.rows))

    def pose(self, motion: Trajectory, tau: Array, prior: Prior | None = None) -> Problem:
        """W beta = b along a motion, the known torque taken from tau (N, n)."""
        b = tau - self.known(motion)
        return Problem(
            parameters=self.task.parameters,
            base=self.base,
            rows=tuple(self.robot.torque_rows[i] for i in self.places),
            factors=fold(self.regression, motion, b, self.places),
            bodies=self.task.bodies,
            blocks=partial(dense_blocks, self.regression, motion, b, self.places),
            samples=len(motion),
            prior=prior,
            kinds=tuple(self.robot.torque_kinds[i] for i in self.places),
        )

    def known(self, motion: Trajectory) -> Array:
        """Torque (N, n) of the parts that the task declares known."""
        if not self.task.knows_something:
            return np.zeros((len(motion), len(self.robot.torque_dofs)))
        tau = newton_euler(self.robot.tree, self.task.known_links, motion)
        return self.robot.reduced(motion.q, tau + known_terms(self.robot, self.task, motion))


def regressor_blocks(
    regression: AnyRegression, rows: tuple[int, ...], motion: Trajectory
) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion."""
    for block in regression.blocks(motion):
        yield block.dense()[:, list(rows)]


def known_terms(robot: RobotModel, task: Task, motion: Trajectory) -> Array:
    """Torque (N, nv) of the joint terms that are known."""
    tau = np.zeros_like(motion.v)
    deflection = _scalar_positions(robot, motion) - robot.joint_terms.spring_reference
    for term, values in task.known_terms.items():
        for dof in np.flatnonzero(values):
            state = deflection[:, dof], motion.v[:, dof], motion.a[:, dof]
            tau[:, dof] += values[dof] * TERM[SUFFIX[term]](*state)
    return tau


def _record(spec: ExperimentSpec, subject: Subject, plant: Plant) -> tuple[Recording, Recording]:
    """The recording as sensed and as filtered."""
    robot, noise = plant.robot, Noise(**spec.noise)
    simulation = subject.build("simulation", spec.simulation)
    processing = processing_of(spec.signals)
    rate = simulation.design_rate(spec.rate)
    every = round(rate / spec.rate)
    design = subject.build("excitation", spec.excitation).design
    commanded = design(brief_of(robot, rate), np.random.default_rng(motion_seed(spec)))
    rng = np.random.default_rng(noise_seed(spec))
    moving = robot.torque_dofs
    draws = draw(len(commanded), len(range(0, len(commanded), every)), len(moving), rng)
    error = encoder_error(noise, draws)
    oracle, controller = simulation.run(plant, commanded, error)
    if noise.quantum > 0:
        # Rounding depends on where the robot is: the positions of a first run tell, the second runs
        # with the loop seeing it.
        scalar = np.flatnonzero(np.isin(moving, robot.scalar_dofs))
        there = _scalar_positions(robot, oracle.motion)[:, moving]
        error = encoder_error(noise, draws, there, scalar)
        oracle, controller = simulation.run(plant, commanded, error)
        # Recorded is what is read where the robot was then: it lies on the encoder's grid.
        there = _scalar_positions(robot, oracle.motion)[:, moving]
        error = encoder_error(noise, draws, there, scalar)
    raw = sense(
        robot,
        oracle,
        error,
        noise.torque_std(oracle.tau[::every]),
        draws,
        every,
        # Without a controller the robot moves exactly as commanded: to tell would be the truth.
        None if controller is None else commanded,
        controller,
        ideal_rates=not processing.differentiate,
    )
    return raw, _completed(robot, processing.apply(raw, robot.joints))


def _completed(robot: RobotModel, recording: Recording) -> Recording:
    """The recording with the joints that follow where filtered signals put the others."""
    if robot.coupling is None:
        return recording
    motion = robot.completed(recording.motion)
    return replace(recording, q=motion.q, v=motion.v, a=motion.a)


def _scalar_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Positions (N, nv) of hinges and slides; zero elsewhere."""
    out = np.zeros_like(motion.v)
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            out[:, joint.vadr] = motion.q[:, joint.qadr]
    return out


def _held_out(spec: ExperimentSpec, subject: Subject, plant: Plant) -> dict[str, Oracle]:
    """Other motions of the same plant, exact: what scoring compares with."""
    motions: dict[str, Oracle] = {}
    for place, excitation in enumerate(spec.held_out):
        rng = np.random.default_rng(held_out_seed(spec, place))
        design = subject.build("excitation", excitation).design
        motion = design(brief_of(plant.robot, spec.rate), rng)
        oracle, _ = Inverse().run(
            plant, motion, np.zeros((len(motion), len(plant.robot.torque_dofs)))
        )
        name = excitation["use"]
        motions[name if name not in motions else f"{name}-{place}"] = oracle
    return motions


def _prior(spec: ExperimentSpec, task: Task) -> Prior | None:
    if spec.prior == "none":
        return None
    spread = None if isinstance(spec.prior, str) else PriorSpread(**spec.prior)
    return prior_of(task, spread, np.random.default_rng(prior_seed(spec)))


@dataclass(frozen=True, eq=False)
class _Simulate:
    """The method's own model along the commanded motion, under the declared controller."""

    told: Declared
    raw: Recording

    def __call__(self, theta: Array) -> Recording:
        controller, commanded = self.raw.controller, self.raw.commanded
        if controller is None or commanded is None:
            raise UnsupportedError(
                "This recording declares no controller: nothing to simulate with."
            )
        theta, size = np.asarray(theta, dtype=float), len(self.told.parameters)
        if theta.shape != (size,):
            raise EstimationError(f"theta has the shape {theta.shape}; expected ({size},).")
        if not np.isfinite(theta).all():
            bad = self.told.parameters[int(np.flatnonzero(~np.isfinite(theta))[0])]
            raise EstimationError(f"theta cannot be simulated: {bad} is not finite.")
        plant = candidate(self.told, theta)
        oracle = ClosedLoop(rate=controller.rate).track(
            plant, controller, commanded, np.zeros((len(commanded), len(controller.kp)))
        )
        every = round(controller.rate / self.raw.rate)
        kept = slice(None, None, every)
        motion = oracle.motion
        return replace(
            self.raw,
            t=motion.t[kept],
            q=motion.q[kept],
            v=motion.v[kept],
            a=motion.a[kept],
            tau=oracle.tau[kept],
        )
