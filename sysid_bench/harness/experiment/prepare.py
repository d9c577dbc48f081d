"""One experiment made ready: simulated once, its regressor reduced once, for all its estimators."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, UnsupportedError
from sysid_bench.evaluation.score import data_figures
from sysid_bench.excitation.brief import Brief, brief_of
from sysid_bench.excitation.geometry import scene_of
from sysid_bench.excitation.insight import Torque, question
from sysid_bench.harness.experiment.motions import designed
from sysid_bench.harness.experiment.robots import Subject
from sysid_bench.harness.experiment.sensing import Sensing, true_offset
from sysid_bench.harness.experiment.spec import (
    ExperimentSpec,
    drift_seed,
    held_out_seed,
    known_seed,
    motion_seed,
    noise_seed,
    prior_seed,
    run_seed,
)
from sysid_bench.identification.calibration import Calibration, calibrate
from sysid_bench.models.extents import extents
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import parse_payload
from sysid_bench.models.prior import PriorSpread, misknown, prior_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Instruments, cut_at, instruments_of
from sysid_bench.models.task import Task, task_of
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.fold import dense_blocks, fold
from sysid_bench.regressors.kernel import newton_euler
from sysid_bench.regressors.regression import TERM, regression
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
    Experiment,
    Extent,
    Oracle,
    Prior,
    Problem,
    Recording,
    Run,
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

    @cached_property
    def reach(self) -> Mapping[str, Extent]:
        """How far each body reaches."""
        return extents(self.robot)


def prepare(spec: ExperimentSpec, subject: Subject) -> Prepared:
    """The experiment of a specification; raises UnsupportedError or UsageError with the reason."""
    robot = subject.robot
    task = told(
        spec, task_of(robot, spec.task, terms_of(spec, robot), spec.sensor, true_offset(spec))
    )
    base = subject.base(task.parameters, task.rows, task.cuts)
    instruments = instruments_of(robot, task.cuts)
    posing = Posing(robot, task, base, torque_regression(robot, base.names, instruments))
    plant = plant_of(robot, [subject.build("plant", spec.plant)])
    sensing = Sensing(spec, plant, task)
    prior = _prior(spec, task)
    briefed = partial(_brief, robot, task, base, prior)
    takes = takes_of(spec, task)
    main = next(take for take in takes if take.loaded)
    raw, recording = _record(spec, subject, plant, sensing, briefed, main)
    runs = _runs(spec, subject, sensing, briefed, takes, Run(True, recording))
    if "calibration" in spec.signals and task.cuts:
        calibration = _calibration(spec, subject, task)
        raw, recording = _corrected(raw, calibration), _corrected(recording, calibration)
    problem = posing.pose(recording.motion, recorded(recording), prior)
    held_out = {
        name: posing.pose(oracle.motion, sensing.exact(oracle))
        for name, oracle in _held_out(spec, subject, plant, briefed).items()
    }
    regress = partial(regressor_blocks, posing.regression, posing.places, instruments)
    model = declared(robot, task)
    simulate = _nothing_to_simulate if task.cuts else _Simulate(model, raw)
    known = _nothing_to_simulate if task.cuts else _Known(model, posing.places)
    experiment = Experiment(problem, recording, raw, regress, simulate, known, runs)
    seal(experiment)
    return Prepared(
        robot, task, problem, experiment, held_out, task.truth,
        posing.known(recording.motion)[:, posing.places],
    )  # fmt: skip


def terms_of(spec: ExperimentSpec, robot: RobotModel) -> tuple[str, ...]:
    """The joint terms that are identified; the robot's own are those of the task `robot`."""
    if spec.terms is not None:
        return spec.terms
    return robot.manifest.terms if spec.task == "robot" else ()


def told(spec: ExperimentSpec, task: Task) -> Task:
    """The task as methods are told it: its known parts with errors where the prior says so."""
    share = 0.0 if isinstance(spec.prior, str) else spec.prior.get("known", 0.0)
    if share == 0.0:
        return task
    return misknown(task, share, np.random.default_rng(known_seed(spec)))


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
    regression: AnyRegression, rows: tuple[int, ...], instruments: Instruments, motion: Trajectory
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
    if robot.coupling is not None or task.cuts:  # designs serve the joints of trees
        return brief
    terms = {  # ball and free joints, whose terms have no columns, are held by designs
        f"{robot.rows[dof]}.{SUFFIX[term]}": float(values[dof])
        for term, values in task.known_terms.items()
        for dof in robot.scalar_dofs
        if values[dof]
    }
    torque = None
    if prior is not None:
        columns = regression(robot, (*task.parameters, *terms))
        torque = Torque(columns, np.array([*prior.theta, *terms.values()]), task.known_links)
    asked = question(robot, base.names, task.rows)
    return replace(brief, regress=asked, torque=torque, scene=partial(scene_of, robot))


Briefed = Callable[[float], Brief]
"""The brief of an experiment at a rate (Hz)."""


@dataclass(frozen=True)
class Take:
    """One recording of the commanded motion: the how manieth, and whether the payload is on."""

    place: int
    loaded: bool
    seed: int  # of its noise


def takes_of(spec: ExperimentSpec, task: Task) -> tuple[Take, ...]:
    """The recordings that an experiment makes, in order. The first loaded one has the noise that it
    has without the others: comparisons are paired."""
    order = spec.signals.get("runs", "B")
    if "A" in order and (task.name != "payload" or task.cuts):
        raise UnsupportedError(
            f"Runs without the payload tell of the payload, from joint torques alone; the task is "
            f"{task.name!r}{' with sensors' if task.cuts else ''}."
        )
    first = order.index("B")
    return tuple(
        Take(i, letter == "B", noise_seed(spec) if i == first else run_seed(spec, i))
        for i, letter in enumerate(order)
    )


def _runs(
    spec: ExperimentSpec,
    subject: Subject,
    sensing: Sensing,
    briefed: Briefed,
    takes: tuple[Take, ...],
    main: Run,
) -> tuple[Run, ...]:
    """All recordings of the commanded motion, `main` among them; none where it is the only one."""
    if len(takes) == 1:
        return ()
    robot = load_robot(subject.robot.manifest, parse_payload("none"), spec.free_base)
    bare = plant_of(robot, [subject.build("plant", spec.plant)])
    plants = {True: sensing.plant, False: bare}
    runs = []
    for take in takes:
        if take.seed == noise_seed(spec):
            runs.append(main)
            continue
        _, recording = _record(spec, subject, plants[take.loaded], sensing, briefed, take)
        runs.append(Run(take.loaded, recording))
    return tuple(runs)


def _drifted(spec: ExperimentSpec, recording: Recording, take: Take, level: float) -> Recording:
    """The recording with torques that drift from the first run on; runs follow at once."""
    if level == 0.0:
        return recording
    slope = level * np.random.default_rng(drift_seed(spec)).normal(size=recording.tau.shape[1])
    start = take.place * len(recording) / recording.rate
    return replace(recording, tau=recording.tau + (recording.t + start)[:, None] * slope)


def _record(
    spec: ExperimentSpec,
    subject: Subject,
    plant: Plant,
    sensing: Sensing,
    briefed: Briefed,
    take: Take | None = None,
) -> tuple[Recording, Recording]:
    """The recording as sensed and as filtered."""
    take = Take(0, True, noise_seed(spec)) if take is None else take
    robot = plant.robot
    noise = Noise(**{k: x for k, x in spec.noise.items() if k not in WRENCH_NOISE})
    simulation = subject.build("simulation", spec.simulation)
    processing = processing_of(spec.signals)
    rate = simulation.design_rate(spec.rate)
    every = round(rate / spec.rate)
    commanded = designed(spec.excitation, subject, briefed(rate), motion_seed(spec))
    rng = np.random.default_rng(take.seed)
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
    raw = sensing.felt(_drifted(spec, raw, take, noise.tau_drift), oracle, every)
    return raw, _completed(robot, processing.apply(raw, robot.joints))


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
        briefed = partial(brief_of, robot)
        _, recording = _record(spec, replace(subject, robot=robot), plant, sensing, briefed)
        instruments = instruments_of(robot, cuts)
        motion = instruments.motion(recording.motion)
        model = newton_euler(instruments.tree, instruments.tree.lumped(robot.phi), motion)
        assert recording.wrench is not None
        readings.append(recording.wrench[:, :6])
        known.append(model[:, robot.nv : robot.nv + 6])
    return calibrate(np.concatenate(readings), np.concatenate(known))


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


def _held_out(
    spec: ExperimentSpec, subject: Subject, plant: Plant, briefed: Briefed
) -> dict[str, Oracle]:
    """Other motions of the same plant, exact: what scoring compares with."""
    motions: dict[str, Oracle] = {}
    for place, excitation in enumerate(spec.held_out):
        seed = held_out_seed(spec, place)
        motion = designed(excitation, subject, briefed(spec.rate), seed)
        oracle, _ = Inverse().run(
            plant, motion, np.zeros((len(motion), len(plant.robot.torque_dofs)))
        )
        name = excitation["use"]
        motions[name if name not in motions else f"{name}-{place}"] = oracle
    return motions


def _prior(spec: ExperimentSpec, task: Task) -> Prior | None:
    if spec.prior == "none":
        return None
    unknowns = {} if isinstance(spec.prior, str) else {**spec.prior}
    unknowns.pop("known", None)
    spread = PriorSpread(**unknowns) if unknowns else None
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
