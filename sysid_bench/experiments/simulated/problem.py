"""Problems W beta = b of a robot and a task, from motions and measured signals; and what methods
may call: regressor, known torque and simulation, without access to the ground truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
from sysid_bench.experiments.processed_rows import (
    MotionRows,
    ProcessedRows,
    RegressorBlock,
    motion_rows,
    row_samples,
    sampled_motion,
)
from sysid_bench.experiments.tasks.task import Task
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Instruments, instruments_of
from sysid_bench.regressors.block_qr import MotionBlocks, motion_factors
from sysid_bench.regressors.kernel_numpy import blocks, motion_part, newton_euler
from sysid_bench.regressors.regression import TERM, Regression
from sysid_bench.regressors.sensor_offset import MeasuredRegressor
from sysid_bench.regressors.wrench import transform_wrench
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.simulation.batched_control import BatchedControl
from sysid_bench.simulation.candidate import Candidate, KnownModel, kinematics_of, plant_of_model
from sysid_bench.simulation.inverse import joint_positions
from sysid_bench.simulation.plant import Plant, plant_of
from sysid_bench.types import (
    Array,
    BaseMap,
    Controller,
    Oracle,
    Prior,
    Problem,
    Recording,
    Trajectory,
)


@dataclass(frozen=True, eq=False)
class ProblemBuilder:
    """Builder of problems of one robot and task.

    A problem goes to methods and never holds its builder, whose task contains the truth.
    """

    robot: RobotModel
    task: Task
    base: BaseMap
    regression: MeasuredRegressor

    @cached_property
    def instruments(self) -> Instruments:
        """The measured signals: joint torques, and the sensors of the task."""
        return instruments_of(self.robot, self.task.cuts)

    @property
    def row_indices(self) -> tuple[int, ...]:
        """Indices of the task's rows among all measured signals."""
        measured = self.instruments.measured
        rows = measured if self.task.rows is None else self.task.rows
        return tuple(measured.index(row) for row in rows)

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the task's rows."""
        return tuple(self.instruments.measured[i] for i in self.row_indices)

    def rows_along(
        self, motion: Trajectory, processing: RowProcessing, free: Array | None = None
    ) -> MotionRows:
        """The processing of the task's rows along a motion; samples that are not `free` (N,) have
        no weight."""
        along = motion_rows(processing, self.robot, self.row_names, motion)
        return along if free is None else replace(along, weights=along.weights * free[:, None])

    def build(
        self,
        motion: Trajectory,
        measured: Array,
        prior: Prior | None = None,
        rows: MotionRows | None = None,
    ) -> Problem:
        """W beta = b along a motion, with b the measured signals (N, n + 6 sensors) minus the known
        torque and the wrenches of the sensors that end the sub-tree; `rows`: their processing."""
        b = self._right_hand_side(motion, measured)
        whole = self.instruments.motion(motion)
        problem = Problem(
            parameters=self.task.parameters,
            base=self.base,
            rows=self.row_names,
            factors=(),
            bodies=self.task.bodies,
            blocks=MotionBlocks(self.regression, whole, b, tuple(self.row_indices)),
            samples=len(motion),
            prior=prior,
            kinds=tuple(self.instruments.kinds[i] for i in self.row_indices),
            # With the known parts, which b lacks: relative errors are those of the whole torque.
            torque=np.sqrt((measured[:, self.row_indices] ** 2).mean(axis=0)),
            mean=measured[:, self.row_indices].mean(axis=0),
            period=motion.period_samples,
        )
        if rows is None or not rows.is_processed:
            factors = motion_factors(self.regression, whole, b, self.row_indices)
            return replace(problem, factors=factors)
        processed = self._processed(whole, b, rows)
        return replace(
            problem,
            factors=processed.factors,
            blocks=processed.blocks,
            samples=rows.samples,
            torque=rows.rms(measured[:, self.row_indices]),
            mean=rows.mean(measured[:, self.row_indices]),
            period=rows.period(motion),
        )

    def _processed(self, whole: Trajectory, b: Array, rows: MotionRows) -> ProcessedRows:
        """The rows of the task along a motion as a pipeline leaves them."""
        blocks: list[RegressorBlock] = list(self.regression.blocks(whole))
        indices = self.row_indices
        return ProcessedRows(
            self.row_names,
            tuple(self.regression.row_columns[i] for i in indices),
            tuple(rows.of_row(k, row_samples(blocks, i, b[:, i])) for k, i in enumerate(indices)),
            rows,
            self.base.rank,
        )

    def _right_hand_side(self, motion: Trajectory, measured: Array) -> Array:
        """b (N, n + 6 sensors) of measured signals."""
        b = measured - self.known(motion)
        # A sub-tree between two sensors feels the difference of their wrenches at one point.
        for stop in self.task.end_sensors:
            cut, names = self.task.cuts[0], self.instruments.measured
            root, end = ([names.index(row) for row in sensor.rows] for sensor in (cut, stop))
            b[:, root] -= transform_wrench(self.instruments, motion, cut, stop, measured[:, end])
        return np.asarray(b)

    def known(self, motion: Trajectory) -> Array:
        """Torque and wrench (N, n + 6 sensors) of the parts that the task declares known."""
        robot, task = self.robot, self.task
        if not task.has_known_part:
            return np.zeros((len(motion), len(self.instruments.measured)))
        whole = self.instruments.motion(motion)
        tau = newton_euler(self.instruments.tree, task.known_links, whole)
        terms = term_torque(robot, task.known_terms, task.known_coupling, motion)
        # Rows of dependent joints act on the independent ones by G'; wrenches are not affected.
        joints = robot.reduced(motion.q, tau[:, : robot.nv] + terms)
        return np.hstack([joints, tau[:, robot.nv :]])


def measured_signals(recording: Recording) -> Array:
    """Measured signals (N, n + 6 sensors): torques, then wrenches."""
    parts = [recording.tau] if recording.wrench is None else [recording.tau, recording.wrench]
    return np.hstack(parts)


def regressor_blocks(
    regression: MeasuredRegressor,
    rows: tuple[int, ...],
    instruments: Instruments,
    motion: Trajectory,
) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion."""
    whole = instruments.motion(motion)
    every = rows == tuple(range(len(regression.rows)))
    if isinstance(regression, Regression):  # filters ask for a few samples at every step
        dense = (regression.dense(motion_part(whole, part)).Y for part in blocks(whole))
    else:
        dense = (block.dense() for block in regression.blocks(whole))
    for Y in dense:
        yield Y if every else Y[:, list(rows)]


def term_torque(
    robot: RobotModel, terms: Mapping[str, Array], coupling: Array | None, motion: Trajectory
) -> Array:
    """Torque (N, nv) of joint terms, by name (nv,), and of a viscous coupling (nv, nv)."""
    tau = np.zeros_like(motion.v)
    # Springs alone depend on positions, relative to their reference.
    deflection = joint_positions(robot, motion) - robot.joint_terms.spring_reference
    if coupling is not None:
        tau += motion.v @ coupling.T
    for term, values in terms.items():
        for dof in np.flatnonzero(values):
            state = deflection[:, dof], motion.v[:, dof], motion.a[:, dof]
            tau[:, dof] += values[dof] * TERM[SUFFIX[term]](*state)
    return tau


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
    one with other gains; one candidate theta (p,), or `many` at once.

    Raises UnsupportedError without a controller, EstimationError for `theta` that cannot be
    simulated.
    """

    model: KnownModel
    raw: Recording
    candidate: Candidate

    def __call__(self, theta: Array, controller: Controller | None = None) -> Recording:
        (outcome,) = self.many([theta], controller)
        if isinstance(outcome, Recording):
            return outcome
        raise outcome

    def many(
        self, thetas: Sequence[Array], controller: Controller | None = None
    ) -> Iterator[Recording | SimulationError | EstimationError]:
        """Simulate many candidates; yield the recording of each, or the error of one that cannot
        be simulated."""
        controller, commanded = controller or self.raw.controller, self.raw.commanded
        if controller is None or commanded is None:
            raise UnsupportedError(
                "This recording declares no controller: nothing to simulate with."
            )
        plants: list[Plant | EstimationError] = []
        for theta in thetas:
            try:
                plants.append(self._plant(theta))
            except EstimationError as error:
                plants.append(error)
        able = [plant for plant in plants if isinstance(plant, Plant)]
        outcomes = self._batched(controller).follow(able, commanded, None)
        # The loop runs at the rate of the controller; its signals are sampled like the measured.
        decimation = round(controller.rate / self.raw.rate)
        for plant in plants:
            outcome = next(outcomes) if isinstance(plant, Plant) else plant
            if not isinstance(outcome, Oracle):
                yield outcome
                continue
            motion, tau = sampled_motion(outcome.motion, decimation), outcome.tau[::decimation]
            yield replace(self.raw, t=motion.t, q=motion.q, v=motion.v, a=motion.a, tau=tau)

    def _batched(self, controller: Controller) -> BatchedControl:
        """The loop of candidates under a controller; the last one is kept, with its compiled
        model. Any candidate will do for that: joint terms and inertias are those of each."""
        kept: BatchedControl | None = vars(self).get("kept")
        if kept is None or kept.controller is not controller:
            control = self.candidate.control(controller.rate)
            kept = BatchedControl(control, plant_of(self.model.robot), controller)
            vars(self)["kept"] = kept
        return kept

    def _plant(self, theta: Array) -> Plant:
        theta = np.asarray(theta, dtype=float)
        names = self.model.parameters
        if theta.shape != (len(names),):
            raise EstimationError(f"theta has the shape {theta.shape}; expected ({len(names)},).")
        if not np.isfinite(theta).all():
            bad = names[int(np.flatnonzero(~np.isfinite(theta))[0])]
            raise EstimationError(f"theta cannot be simulated: {bad} is not finite.")
        return self.candidate.plant(plant_of_model(self.model, theta))


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
