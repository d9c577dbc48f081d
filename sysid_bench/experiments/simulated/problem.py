"""Problems W beta = b of a robot and a task, from motions and measured signals."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Instruments, instruments_of
from sysid_bench.regressors.block_qr import accumulate, dense_blocks
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.nested_sensors import MeasuredRegressor
from sysid_bench.regressors.regression import TERM
from sysid_bench.regressors.wrench import transform_wrench
from sysid_bench.tasks.task import Task
from sysid_bench.types import Array, BaseMap, Prior, Problem, Recording, Trajectory


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

    def build(self, motion: Trajectory, measured: Array, prior: Prior | None = None) -> Problem:
        """W beta = b along a motion, with b the measured signals (N, n + 6 sensors) minus the known
        torque and the wrenches of the sensors that end the sub-tree."""
        b = measured - self.known(motion)
        # A sub-tree between two sensors feels the difference of their wrenches at one point.
        for stop in self.task.end_sensors:
            cut, names = self.task.cuts[0], self.instruments.measured
            root, end = ([names.index(row) for row in sensor.rows] for sensor in (cut, stop))
            b[:, root] -= transform_wrench(self.instruments, motion, cut, stop, measured[:, end])
        motion = self.instruments.motion(motion)
        return Problem(
            parameters=self.task.parameters,
            base=self.base,
            rows=tuple(self.instruments.measured[i] for i in self.row_indices),
            factors=accumulate(self.regression, motion, b, self.row_indices),
            bodies=self.task.bodies,
            blocks=partial(dense_blocks, self.regression, motion, b, self.row_indices),
            samples=len(motion),
            prior=prior,
            kinds=tuple(self.instruments.kinds[i] for i in self.row_indices),
            # With the known parts, which b lacks: relative errors are those of the whole torque.
            torque=np.sqrt((measured[:, self.row_indices] ** 2).mean(axis=0)),
            period=motion.period_samples,
        )

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
    for block in regression.blocks(instruments.motion(motion)):
        yield block.dense()[:, list(rows)]


def term_torque(
    robot: RobotModel, terms: Mapping[str, Array], coupling: Array | None, motion: Trajectory
) -> Array:
    """Torque (N, nv) of joint terms, by name (nv,), and of a viscous coupling (nv, nv)."""
    tau = np.zeros_like(motion.v)
    # Springs alone depend on positions, relative to their reference.
    deflection = scalar_positions(robot, motion) - robot.joint_terms.spring_reference
    if coupling is not None:
        tau += motion.v @ coupling.T
    for term, values in terms.items():
        for dof in np.flatnonzero(values):
            state = deflection[:, dof], motion.v[:, dof], motion.a[:, dof]
            tau[:, dof] += values[dof] * TERM[SUFFIX[term]](*state)
    return tau


def scalar_positions(robot: RobotModel, motion: Trajectory) -> Array:
    """Positions (N, nv) of hinges and slides (rad, m); zero for other joints."""
    out = np.zeros_like(motion.v)
    for joint in robot.joints:
        if joint.kind in ("hinge", "slide"):
            out[:, joint.vadr] = motion.q[:, joint.qadr]
    return out
