"""One experiment made ready: simulated once, its regressor reduced once, for all its estimators."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, UnsupportedError, UsageError
from sysid_bench.evaluation.cramer_rao import torque_bound, white_bound
from sysid_bench.evaluation.score import data_figures
from sysid_bench.excitation.brief import Brief, brief_of
from sysid_bench.excitation.geometry import scene_of
from sysid_bench.excitation.insight import Torque, question
from sysid_bench.harness.canonical import canonical
from sysid_bench.harness.experiment.motions import designed
from sysid_bench.harness.experiment.robots import Subject
from sysid_bench.harness.experiment.sensing import Sensing, kept_motion, true_offset
from sysid_bench.harness.experiment.spec import (
    REDRAWN,
    ExperimentSpec,
    held_out_seed,
    motion_seed,
    noise_seed,
    prior_seed,
)
from sysid_bench.identification.calibration import Calibration, calibrate
from sysid_bench.identification.contact import free_samples
from sysid_bench.identification.online import rows_of
from sysid_bench.models.extents import extents
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.prior import PriorSpread, prior_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Instruments, cut_at, instruments_of
from sysid_bench.models.task import SENSOR_TASKS, Task, task_of
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.ended import Sensed, sensed_regression
from sysid_bench.regressors.fold import dense_blocks, fold
from sysid_bench.regressors.kernel import newton_euler
from sysid_bench.regressors.regression import TERM
from sysid_bench.regressors.wrench import handed_on
from sysid_bench.signals.process import processing_of
from sysid_bench.simulation.candidate import Declared, candidate, declared
from sysid_bench.simulation.closed_loop import ClosedLoop
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.simulation.sensors import Noise, draw, encoder_error, sense
from sysid_bench.simulation.wrench import WRENCH_NOISE
from sysid_bench.types import (
    Array,
    BaseMap,
    Controller,
    Experiment,
    Extent,
    Oracle,
    Prior,
    Problem,
    Recording,
    Trajectory,
    Truth,
)
from sysid_bench.units import interval


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
    stage: "Stage"

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Rank and conditioning of the data: one and the same for all estimators."""
        return data_figures(self.problem, self.held_out) | {"left_out": self.left_out}

    @property
    def reach(self) -> Mapping[str, Extent]:
        """How far each body reaches."""
        return self.stage.reach


def prepare(spec: ExperimentSpec, subject: Subject) -> Prepared:
    """The experiment of a specification; raises UnsupportedError or UsageError with the reason."""
    stage = _stage(canonical(_noise_free(spec).to_json()), subject)
    task, posing, plant = stage.task, stage.posing, stage.take.plant
    taken = _record(spec, stage.take, Sensing(spec, plant, task))
    raw, recording = taken.raw, taken.recording
    if "calibration" in spec.signals and task.cuts:
        calibration = _calibration(spec, subject, task)
        raw, recording = _corrected(raw, calibration), _corrected(recording, calibration)
    recording, left_out = _free_of_contact(spec.signals.get("contacts"), recording, posing)
    problem = posing.pose(recording.motion, recorded(recording), stage.prior)
    regress = partial(regressor_blocks, posing.regression, posing.places, posing.instruments)
    simulate = _nothing_to_simulate if task.cuts else _Simulate(stage.told, raw)
    known = _nothing_to_simulate if task.cuts else _Known(stage.told, posing.places)
    experiment = Experiment(problem, recording, raw, regress, simulate, known)
    seal(experiment)
    return Prepared(
        subject.robot, task, problem, experiment, stage.held_out, task.truth,
        posing.known(recording.motion)[:, posing.places], taken.bound(posing), bool(spec.noise),
        left_out, stage,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Stage:
    """All of an experiment that its noise does not touch: levels and repeats share it."""

    spec: ExperimentSpec
    task: Task
    posing: "Posing"
    take: "Take"
    prior: Prior | None

    @cached_property
    def told(self) -> Declared:
        """The robot as methods may know it."""
        return declared(self.posing.robot, self.task)

    @cached_property
    def reach(self) -> Mapping[str, Extent]:
        """How far each body reaches."""
        return extents(self.posing.robot)

    @cached_property
    def held_out(self) -> dict[str, Problem]:
        """Other motions, posed with exact signals."""
        sensing = Sensing(self.spec, self.take.plant, self.task)
        return {
            name: self.posing.pose(oracle.motion, sensing.exact(oracle))
            for name, oracle in _held_out(self.spec, self.take).items()
        }


def _noise_free(spec: ExperimentSpec) -> ExperimentSpec:
    """What of a specification its stage hangs on. How a force/torque sensor was made is a part of
    the noise, and of what such a task asks for."""
    if spec.task in SENSOR_TASKS:
        return spec
    redrawn = not isinstance(spec.prior, str) and spec.prior.get(REDRAWN)
    return replace(spec, noise={}, signals={}, repeat=spec.repeat if redrawn else 0)


@lru_cache(maxsize=2)
def _stage(text: str, subject: Subject) -> Stage:
    """The stage of a specification, as canonical JSON."""
    spec, robot = ExperimentSpec.from_json(json.loads(text)), subject.robot
    task = task_of(robot, spec.task, terms_of(spec, robot), spec.sensor, partial(true_offset, spec))
    base = subject.base(task.parameters, task.rows, task.cuts)
    instruments = instruments_of(robot, task.cuts)
    columns = sensed_regression(robot, base.names, instruments, task.rows)
    posing = Posing(robot, task, base, columns)
    plant = plant_of(robot, [subject.build("plant", spec.plant)])
    prior = _prior(spec, task)
    take = Take(spec, subject, plant, partial(_brief, robot, task, base, prior))
    return Stage(spec, task, posing, take, prior)


def terms_of(spec: ExperimentSpec, robot: RobotModel) -> tuple[str, ...]:
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
    regression: Sensed

    @cached_property
    def instruments(self) -> Instruments:
        """What is measured: joint torques, and the sensors of the task."""
        return instruments_of(self.robot, self.task.cuts)

    @property
    def places(self) -> tuple[int, ...]:
        """The rows that the task measures, as places among all that is measured."""
        own = self.instruments.measured
        return tuple(own.index(row) for row in (own if self.task.rows is None else self.task.rows))

    def pose(self, motion: Trajectory, measured: Array, prior: Prior | None = None) -> Problem:
        """W beta = b along a motion, what is known taken from what is measured (N, n + 6 sensors):
        known torque, and the wrenches of the sensors that end the sub-tree."""
        b = measured - self.known(motion)
        for stop in self.task.stops:
            cut, names = self.task.cuts[0], self.instruments.measured
            root, end = ([names.index(row) for row in at.rows] for at in (cut, stop))
            b[:, root] -= handed_on(self.instruments, motion, cut, stop, measured[:, end])
        motion = self.instruments.motion(motion)
        return Problem(
            parameters=self.task.parameters,
            base=self.base,
            rows=tuple(self.instruments.measured[i] for i in self.places),
            factors=fold(self.regression, motion, b, self.places),
            bodies=self.task.bodies,
            blocks=partial(dense_blocks, self.regression, motion, b, self.places),
            samples=len(motion),
            prior=prior,
            kinds=tuple(self.instruments.kinds[i] for i in self.places),
            torque=np.sqrt((measured[:, self.places] ** 2).mean(axis=0)),
            period=motion.period_samples,
        )

    def known(self, motion: Trajectory) -> Array:
        """Torque and wrench (N, n + 6 sensors) of the parts that the task declares known."""
        robot, task = self.robot, self.task
        if not task.knows_something:
            return np.zeros((len(motion), len(self.instruments.measured)))
        whole = self.instruments.motion(motion)
        tau = newton_euler(self.instruments.tree, task.known_links, whole)
        terms = term_torque(robot, task.known_terms, task.known_coupling, motion)
        joints = robot.reduced(motion.q, tau[:, : robot.nv] + terms)
        return np.hstack([joints, tau[:, robot.nv :]])


def recorded(recording: Recording) -> Array:
    """All that is measured (N, n + 6 sensors): torque, then wrenches."""
    parts = [recording.tau] if recording.wrench is None else [recording.tau, recording.wrench]
    return np.hstack(parts)


def regressor_blocks(
    regression: Sensed,
    rows: tuple[int, ...],
    instruments: Instruments,
    motion: Trajectory,
) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion."""
    for block in regression.blocks(instruments.motion(motion)):
        yield block.dense()[:, list(rows)]


def term_torque(
    robot: RobotModel, terms: Mapping[str, Array], coupling: Array | None, motion: Trajectory
) -> Array:
    """Torque (N, nv) of joint terms, by name (nv,), and of a viscous coupling (nv, nv)."""
    tau = np.zeros_like(motion.v)
    deflection = _scalar_positions(robot, motion) - robot.joint_terms.spring_reference
    if coupling is not None:
        tau += motion.v @ coupling.T
    for term, values in terms.items():
        for dof in np.flatnonzero(values):
            state = deflection[:, dof], motion.v[:, dof], motion.a[:, dof]
            tau[:, dof] += values[dof] * TERM[SUFFIX[term]](*state)
    return tau


@dataclass(frozen=True, eq=False)
class _Known:
    """What methods are told of the torque along any motion."""

    told: Declared
    places: tuple[int, ...]

    def __call__(self, motion: Trajectory) -> Array:
        told = self.told
        tau = newton_euler(told.robot.tree, told.known_links, motion)
        tau += term_torque(told.robot, told.known_terms, told.known_coupling, motion)
        return told.robot.reduced(motion.q, tau)[:, list(self.places)]


def _brief(robot: RobotModel, task: Task, base: BaseMap, prior: Prior | None, rate: float) -> Brief:
    """What a designer of motions is told: limits, the question, and torques by the prior alone."""
    brief = brief_of(robot, rate)
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
        torque = Torque(columns, theta, task.known_links, robot.tree, robot.coupling)
    asked = question(robot, base.names, task.rows, task.cuts)
    return replace(brief, regress=asked, torque=torque, scene=partial(scene_of, robot))


Briefed = Callable[[float], Brief]
"""The brief of an experiment at a rate (Hz)."""


@dataclass(frozen=True, eq=False)
class Take:
    """A plant that moves as an excitation says."""

    spec: ExperimentSpec
    subject: Subject
    plant: Plant
    briefed: Briefed

    @cached_property
    def simulation(self) -> Any:
        """What moves it."""
        return self.subject.build("simulation", self.spec.simulation)

    @property
    def every(self) -> int:
        """Steps of the simulation per sample of the recording."""
        return round(self.simulation.design_rate(self.spec.rate) / self.spec.rate)

    @cached_property
    def commanded(self) -> Trajectory:
        """The motion that is asked for."""
        brief = self.briefed(self.simulation.design_rate(self.spec.rate))
        return designed(self.spec.excitation, self.subject, brief, motion_seed(self.spec))

    def run(self, error: Array) -> tuple[Oracle, Controller | None]:
        """What happens where encoders err so much (N, n)."""
        if type(self.simulation) is Inverse:  # which no encoder disturbs
            return self._undisturbed, None
        oracle, controller = self.simulation.run(self.plant, self.commanded, error)
        return oracle, controller

    @cached_property
    def _undisturbed(self) -> Oracle:
        still = np.zeros((len(self.commanded), len(self.plant.robot.torque_dofs)))
        oracle: Oracle = self.simulation.run(self.plant, self.commanded, still)[0]
        return oracle


@dataclass(frozen=True, eq=False)
class Taken:
    """The recording as sensed and as filtered, and what only scoring may know of it."""

    raw: Recording
    recording: Recording
    oracle: Oracle
    every: int
    torque_std: Array  # (n,) of the torque noise
    correlation: float  # of that noise from sample to sample

    def bound(self, posing: "Posing") -> Array | None:
        """The Cramer-Rao bound (r,) as standard deviations where torque alone is noisy; None where
        a row has no noise of that kind, or the motion does not excite every direction."""
        if posing.task.cuts or not (self.torque_std[list(posing.places)] > 0).all():
            return None
        return _bound(posing, self.oracle, self.every, tuple(self.torque_std), self.correlation)


@lru_cache(maxsize=2)
def _bound(
    posing: "Posing", oracle: Oracle, every: int, std: tuple[float, ...], correlation: float
) -> Array | None:
    motion, places = kept_motion(oracle.motion, every), posing.places
    of_rows = np.array(std)[list(places)]
    if correlation == 0.0:
        found = white_bound(posing.pose(motion, oracle.tau[::every]), of_rows)
    else:  # rows that are whitened in time are dense
        rows = regressor_blocks(posing.regression, places, posing.instruments, motion)
        found = torque_bound(rows, np.diag(of_rows**2), correlation)
    return None if found is None else np.sqrt(np.diag(found))


def _record(spec: ExperimentSpec, take: Take, sensing: Sensing) -> Taken:
    """The recording of one repeat."""
    robot, every, commanded = take.plant.robot, take.every, take.commanded
    noise = Noise(**{k: x for k, x in spec.noise.items() if k not in WRENCH_NOISE})
    processing = processing_of(spec.signals)
    rng = np.random.default_rng(noise_seed(spec))
    moving = robot.torque_dofs
    draws = draw(len(commanded), len(range(0, len(commanded), every)), len(moving), rng)
    error = encoder_error(noise, draws)
    oracle, controller = take.run(error)
    if noise.quantum > 0:
        # Rounding depends on where the robot is: the positions of a first run tell, the second runs
        # with the loop seeing it.
        scalar = np.flatnonzero(np.isin(moving, robot.scalar_dofs))
        there = _scalar_positions(robot, oracle.motion)[:, moving]
        error = encoder_error(noise, draws, there, scalar)
        oracle, controller = take.run(error)
        # Recorded is what is read where the robot was then: it lies on the encoder's grid.
        there = _scalar_positions(robot, oracle.motion)[:, moving]
        error = encoder_error(noise, draws, there, scalar)
    torque_std = noise.torque_std(oracle.tau[::every])
    raw = sense(
        robot,
        oracle,
        error,
        torque_std * noise.in_time(draws.torque),
        every,
        # Without a controller the robot moves exactly as commanded: to tell would be the truth.
        None if controller is None else commanded,
        controller,
        ideal_rates=not processing.differentiate,
    )
    raw = sensing.felt(raw, oracle, every)
    recording = _completed(robot, processing.apply(raw, robot.joints))
    return Taken(raw, recording, oracle, every, torque_std, noise.tau_correlation)


def _completed(robot: RobotModel, recording: Recording) -> Recording:
    """The recording with the joints that follow where filtered signals put the others."""
    if robot.coupling is None:
        return recording
    motion = robot.completed(recording.motion)
    return replace(recording, q=motion.q, v=motion.v, a=motion.a)


def _calibration(spec: ExperimentSpec, subject: Subject, task: Task) -> Calibration:
    """What the measured sensor tells of itself with known payloads, on the same motion."""
    readings, known = [], []
    for run, load in enumerate(spec.signals["calibration"], 1):
        robot = load_robot(subject.robot.manifest, parse_payload(load), spec.free_base)
        cuts = tuple(cut_at(robot, cut.at, ()) for cut in task.cuts)
        plant = plant_of(robot, [subject.build("plant", spec.plant)])
        sensing = Sensing(spec, plant, replace(task, cuts=cuts), run)
        take = Take(spec, replace(subject, robot=robot), plant, partial(brief_of, robot))
        recording = _record(spec, take, sensing).recording
        instruments = instruments_of(robot, cuts)
        motion = instruments.motion(recording.motion)
        model = newton_euler(instruments.tree, instruments.tree.lumped(robot.phi), motion)
        assert recording.wrench is not None
        readings.append(recording.wrench[:, :6])
        known.append(model[:, robot.nv : robot.nv + 6])
    return calibrate(np.concatenate(readings), np.concatenate(known))


def _free_of_contact(
    contacts: Any, recording: Recording, posing: Posing
) -> tuple[Recording, float]:
    """The recording without contact periods, declared or found, and the share that is left out."""
    if not contacts:
        return recording, 0.0
    if contacts == "detect":
        free = free_samples(*rows_of(posing.pose(recording.motion, recorded(recording))))
    else:
        t, free = recording.t, np.ones(len(recording), dtype=bool)
        for start, end in map(interval, contacts):
            free &= ~((t >= start) & (t < end))
        if not free.any():
            raise UsageError(
                f"The contact periods {', '.join(contacts)} leave nothing of a recording from "
                f"{t[0]:g} s to {t[-1]:g} s."
            )
    motion = recording.motion
    kept = replace(
        recording, t=motion.t[free], q=motion.q[free], v=motion.v[free], a=motion.a[free],
        tau=recording.tau[free], period=None,
        wrench=None if recording.wrench is None else recording.wrench[free],
    )  # fmt: skip
    return kept, 1.0 - float(free.mean())


def _corrected(recording: Recording, calibration: Calibration) -> Recording:
    """The recording with the first sensor's reading corrected."""
    assert recording.wrench is not None
    wrench = recording.wrench.copy()
    wrench[:, :6] = calibration.corrected(wrench[:, :6])
    return replace(recording, wrench=wrench)


def _scalar_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Positions (N, nv) of hinges and slides; zero elsewhere."""
    out = np.zeros_like(motion.v)
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            out[:, joint.vadr] = motion.q[:, joint.qadr]
    return out


def _held_out(spec: ExperimentSpec, take: Take) -> dict[str, Oracle]:
    """Other motions of the same plant, exact: what scoring compares with."""
    motions: dict[str, Oracle] = {}
    for place, excitation in enumerate(spec.held_out):
        seed = held_out_seed(spec, place)
        motion = designed(excitation, take.subject, take.briefed(spec.rate), seed)
        still = np.zeros((len(motion), len(take.plant.robot.torque_dofs)))
        oracle, _ = Inverse().run(take.plant, motion, still)
        name = excitation["use"]
        motions[name if name not in motions else f"{name}-{place}"] = oracle
    return motions


def _prior(spec: ExperimentSpec, task: Task) -> Prior | None:
    if spec.prior == "none":
        return None
    spread = None
    if not isinstance(spec.prior, str):
        spread = PriorSpread(**{key: far for key, far in spec.prior.items() if key != REDRAWN})
    return prior_of(task, spread, np.random.default_rng(prior_seed(spec)))


def _nothing_to_simulate(asked: Any) -> Any:
    """What a loop needs beside the sensors is not declared."""
    raise UnsupportedError(
        "A task with force/torque sensors declares no whole robot: nothing to simulate with."
    )


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
