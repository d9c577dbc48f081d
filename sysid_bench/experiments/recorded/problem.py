"""Problems W beta = b of logs, as triangular factors row by row."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final

import numpy as np

from sysid_bench.experiments.processed_rows import (
    MotionRows,
    ProcessedRows,
    RegressorBlock,
    motion_rows,
    row_factor,
    row_samples,
)
from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.experiments.recorded.unknowns import MASS, Unknowns
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import SensorSubtree
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.sensor_offset import (
    MeasuredBlock,
    MeasuredRegressor,
    measured_regression,
)
from sysid_bench.regressors.wrench import transform_wrench
from sysid_bench.signals.spectrum import time_fold
from sysid_bench.types import Array, BaseMap, Factor, Problem, RowBlock, Trajectory

UNUSED: Final = -1
"""Label of samples that are in no factor."""


@dataclass(frozen=True, eq=False)
class LogProblemBuilder:
    """Builder of problems in the base parameters named `columns`."""

    unknowns: Unknowns
    columns: tuple[str, ...]
    preprocessing: LogProcessing

    def build(self, logs: Sequence[ProcessedLog], base: BaseMap) -> Problem:
        """The problem W beta = b of all rows of the logs, which knows those of the single ones."""
        along = [self.rows_along(log) for log in logs]
        parts = [self.factors(log, np.zeros(len(log.recording), dtype=int), 1)[0] for log in logs]
        motions = []
        for log, factors, one in zip(logs, parts, along, strict=True):
            motion = log.recording.motion
            problem = self._problem([log], [one], factors, base)
            motions.append(
                replace(problem, period=one.period(motion), repetition=one.repetition(motion))
            )
        if len(logs) == 1:
            return motions[0]
        factors = [row_factor(row) for row in zip(*parts, strict=True)]
        return replace(self._problem(logs, along, factors, base), motions=tuple(motions))

    def _problem(
        self,
        logs: Sequence[ProcessedLog],
        along: Sequence[MotionRows],
        factors: Sequence[Factor],
        base: BaseMap,
    ) -> Problem:
        squares, means = [], []  # of the measured torque of each joint, known parts included
        measured = [self._row_signals(log) for log in logs]
        for i in range(len(self.unknowns.rows)):
            parts = [one.row_values(i, x[:, i]) for x, one in zip(measured, along, strict=True)]
            count = sum(one.count(i) for one in along)
            values = np.concatenate(parts)
            squares.append(float((values**2).sum()) / max(count, 1))
            means.append(float(values.sum()) / max(count, 1))
        return Problem(
            parameters=self.unknowns.parameters,
            base=base,
            rows=self.unknowns.rows,
            # QR of each row by itself: weights of rows can be changed without the samples.
            factors=tuple(factors),
            bodies=self.unknowns.bodies,
            blocks=partial(_blocks, self, tuple(logs)),
            samples=sum(one.samples for one in along),
            kinds=self.unknowns.kinds,
            torque=np.sqrt(squares),
            mean=np.array(means),
        )

    def regression(self, log: ProcessedLog) -> tuple[MeasuredRegressor, Array]:
        """The regression of the columns that act in a log, and their indices among all (k,)."""
        return self._rigid_regression(*self.unknowns.rigid_bodies(log))

    @cached_property
    def without_load(self) -> tuple[MeasuredRegressor, Array]:
        """The regression of the robot's own columns, and their indices: methods that simulate call
        it at every step."""
        return self._rigid_regression(self.unknowns.robot, self.unknowns.robot_parameters)

    def _rigid_regression(
        self, robot: RobotModel, parameters: Collection[str]
    ) -> tuple[MeasuredRegressor, Array]:
        """The regression of those columns that are among some parameters, and their indices."""
        known = set(parameters)
        indices = [i for i, name in enumerate(self.columns) if name in known]
        names = [self.columns[i] for i in indices]
        instruments, rows = self.unknowns.instruments(robot), self.unknowns.rows
        return measured_regression(robot, names, instruments, rows), np.array(indices)

    def motion(self, log: ProcessedLog) -> Trajectory:
        """The motion of a log in the coordinates of its regression: those of sensors as well."""
        return self.unknowns.instruments(log.robot).motion(log.recording.motion)

    def known(self, log: ProcessedLog, motion: Trajectory) -> Array | None:
        """Torque (N, n) of the payload of a log along a motion; None where there is none, or one
        with unknown parameters, which has columns."""
        load = log.robot.payload_body
        if load is None or self.unknowns.loaded is not None:
            return None
        columns, instruments = log.robot.bodies[load].columns, self.unknowns.instruments(log.robot)
        regression = torque_regression(log.robot, columns, instruments)
        return regression.torque(instruments.motion(motion), log.robot.phi[load])

    def torque(self, log: ProcessedLog) -> Array:
        """Measured torque (N, n), with a sensor its wrench behind it, minus that of a known payload
        and that of sensors which end the sub-tree."""
        tau, motion = log.recording.tau, log.recording.motion
        if self.unknowns.sub_tree is not None:
            instruments = self.unknowns.instruments(log.robot)
            wrench = _measured_wrench(log, instruments.cuts)
            root = wrench[:, :6].copy()
            for k, stop in enumerate(instruments.cuts[1:], start=1):
                # A sub-tree between two sensors feels the difference of their wrenches at one
                # point.
                end = wrench[:, 6 * k : 6 * k + 6]
                root -= transform_wrench(instruments, motion, instruments.cuts[0], stop, end)
            tau = np.hstack([tau, root, wrench[:, 6:]])
        known = self.known(log, motion)
        return tau if known is None else np.asarray(tau - known)

    def factors(self, log: ProcessedLog, labels: Array, count: int) -> list[list[Factor]]:
        """For each label 0 ... count - 1 the factors of all joints at samples that have it (N,),
        in one pass over the motion."""
        along = self.rows_along(log)
        if along.is_processed:
            return self._processed(log, along).factors_by_label(labels, count)
        regression, indices = self.regression(log)
        tau, rows = self.torque(log), []
        for row in self.unknowns.rows:
            i = regression.rows.index(row)
            extra, more = self.extra_columns(log, row)
            columns = np.concatenate([indices[regression.row_columns[i]], more])
            used = np.where(self._moving_rows(log, row), labels, UNUSED)
            rows.append((row, i, columns, extra, used))
        shapes = [(0, len(columns) + 1) for _, _, columns, _, _ in rows]
        Rs = [[np.zeros(shape) for shape in shapes] for _ in range(count)]
        for block in regression.blocks(self.motion(log)):
            part = block.samples
            for k, (_, i, _, extra, used) in enumerate(rows):
                Wb = np.column_stack([block.row(i).T, extra[part], tau[part, i]])
                for label in range(count):
                    chosen = used[part] == label
                    if chosen.any():
                        Rs[label][k] = qr_factor([Rs[label][k], Wb[chosen]])
        return [
            [
                Factor(row, columns, R, int((used == label).sum()))
                for (row, _, columns, _, used), R in zip(rows, Rs[label], strict=True)
            ]
            for label in range(count)
        ]

    def motors(self, motion: Trajectory) -> Trajectory | None:
        """Motion of the motors along a motion of the robot."""
        features = self.unknowns.features
        return None if features is None else features.motors_of(self.unknowns.robot, motion)

    def extra_columns(self, log: ProcessedLog, row: str) -> tuple[Array, Array]:
        """Feature columns (N, k) of one joint, and their indices among all."""
        values, indices = self.features(row, log.recording.motion, log.motors)
        if self.unknowns.given and log.payload:
            i, body = log.robot.torque_rows.index(row), log.robot.payload_body
            assert body is not None
            regression = torque_regression(log.robot, log.robot.bodies[body].columns)
            # phi is linear in the mass where the centre of mass and the inertia per mass are given.
            per_kilogram = log.robot.phi[body] / log.payload.mass
            torque = np.asarray(regression.torque(log.recording.motion, per_kilogram))
            values = np.column_stack([values, torque[:, i]])
            indices = np.append(indices, self.columns.index(MASS))
        return values, indices

    def features(
        self, row: str, motion: Trajectory, motors: Trajectory | None
    ) -> tuple[Array, Array]:
        """Values (N, k) of the features on one joint's row, and their indices among all columns."""
        if self.unknowns.features is None:
            return np.zeros((len(motion), 0)), np.zeros(0, dtype=int)
        chosen = [name for name in self.unknowns.extra if name in self.columns]
        names, values = self.unknowns.features.on_row(row, chosen, motion, motors)
        return values, np.array([self.columns.index(name) for name in names], dtype=int)

    def dense(
        self, block: MeasuredBlock, indices: Array, features: Sequence[tuple[Array, Array]]
    ) -> Array:
        """Base regressor (n, rows, r) of one block: the rigid-body columns have these `indices`
        (k,), those of `features` are given for each row with their values."""
        names = block.regression.rows
        rows = [names.index(row) for row in self.unknowns.rows]
        W = np.zeros((block.count, len(rows), len(self.columns)))
        W[:, :, indices] = block.dense()[:, rows]
        for i, (values, columns) in enumerate(features):
            W[:, i, columns] = values[block.samples]
        return W

    def blocks(self, log: ProcessedLog) -> Iterator[RowBlock]:
        """Dense rows W, b of a log; those that are left out are zero."""
        along = self.rows_along(log)
        if along.is_processed:
            yield from self._processed(log, along).blocks()
            return
        regression, indices = self.regression(log)
        names, tau = self.unknowns.rows, self.torque(log)
        rows = [regression.rows.index(row) for row in names]
        moving = np.stack([self._moving_rows(log, row) for row in names], axis=1)
        features = [self.extra_columns(log, row) for row in names]
        for block in regression.blocks(self.motion(log)):
            kept = moving[block.samples]
            W = self.dense(block, indices, features)
            yield W * kept[:, :, None], tau[block.samples][:, rows] * kept

    def _row_signals(self, log: ProcessedLog) -> Array:
        """Measured signals (N, rows), known parts included."""
        names, tau = log.robot.torque_rows, log.recording.tau
        if self.unknowns.sub_tree is not None:
            return _measured_wrench(log, self.unknowns.sub_tree.cuts[:1])
        return np.asarray(tau[:, [names.index(row) for row in self.unknowns.rows]])

    def rows_along(self, log: ProcessedLog) -> MotionRows:
        """The processing of the rows of a log; those of slow joints have no weight."""
        moving = [self._moving_rows(log, row) for row in self.unknowns.rows]
        rows = motion_rows(log.rows, log.robot, self.unknowns.rows, log.recording.motion)
        return replace(rows, weights=rows.weights * np.stack(moving, axis=1))

    def left_out(self, logs: Sequence[ProcessedLog]) -> float:
        """Share of the rows of some logs that are left out."""
        return float(np.concatenate([self.rows_along(log).weights == 0.0 for log in logs]).mean())

    def _processed(self, log: ProcessedLog, along: MotionRows) -> ProcessedRows:
        """The rows of a log as its pipeline leaves them."""
        regression, known = self.regression(log)
        blocks: list[RegressorBlock] = list(regression.blocks(self.motion(log)))
        names, tau = self.unknowns.rows, self.torque(log)
        columns, values = [], []
        for k, row in enumerate(names):
            i, (extra, indices) = regression.rows.index(row), self.extra_columns(log, row)
            columns.append(np.concatenate([known[regression.row_columns[i]], indices]))
            values.append(along.of_row(k, row_samples(blocks, i, tau[:, i], extra)))
        return ProcessedRows(names, tuple(columns), tuple(values), along, len(self.columns))

    def _moving_rows(self, log: ProcessedLog, row: str) -> Array:
        """Samples (N,) at which a joint moves fast enough."""
        if row not in log.robot.rows:  # of a sensor, which no friction acts on
            return np.ones(len(log.recording), dtype=bool)
        # Below the threshold static friction may balance any torque up to its limit.
        v = log.recording.motion.v[:, log.robot.rows.index(row)]
        return np.asarray(np.abs(v) >= self.preprocessing.moving)


def _measured_wrench(log: ProcessedLog, cuts: Sequence[SensorSubtree]) -> Array:
    """Recorded wrenches [n; f] (N, 6 sensors) of some sensors."""
    assert log.recording.wrench is not None
    names = log.recording.wrench_rows
    columns = [names.index(row) for cut in cuts for row in cut.rows]
    return np.asarray(log.recording.wrench[:, columns])


def _blocks(builder: LogProblemBuilder, logs: tuple[ProcessedLog, ...]) -> Iterator[RowBlock]:
    """Dense rows W, b; those of joints that move too slowly are zero."""
    for log in logs:
        yield from builder.blocks(log)


def fold_factors(
    builder: LogProblemBuilder, logs: Sequence[ProcessedLog], count: int
) -> list[list[tuple[Factor, ...]]]:
    """For each part and each joint the factors of all logs."""
    log_factors = [
        builder.factors(log, time_fold(log.recording.motion, count)[0], count) for log in logs
    ]
    rows = range(len(builder.unknowns.rows))
    return [[tuple(factors[f][k] for factors in log_factors) for k in rows] for f in range(count)]


def regressor_blocks(builder: LogProblemBuilder, motion: Trajectory) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion of the unloaded robot."""
    unknowns = builder.unknowns
    regression, indices = builder.without_load
    instruments = unknowns.instruments(unknowns.robot)
    motors = builder.motors(motion)
    features = [builder.features(row, motion, motors) for row in unknowns.rows]
    for block in regression.blocks(instruments.motion(motion)):
        yield builder.dense(block, indices, features)


def predict_torque(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Measured and predicted torque (N, rows) of a problem's rows."""
    pairs = [(b, W @ beta) for W, b in problem.blocks()]
    return np.concatenate([b for b, _ in pairs]), np.concatenate([w for _, w in pairs])
