"""Problems W beta = b of logs, as triangular factors row by row."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sysid_bench.experiments.recorded.preprocess import Preprocessing, ProcessedLog
from sysid_bench.experiments.recorded.unknowns import MASS, Unknowns
from sysid_bench.qr_factor import upper_factor
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.signals.time_folds import time_folds
from sysid_bench.types import Array, BaseMap, Factor, Problem, RowBlock, Trajectory


@dataclass(frozen=True, eq=False)
class LogProblemBuilder:
    """Builder of problems in the base parameters named `columns`."""

    unknowns: Unknowns
    columns: tuple[str, ...]
    preprocessing: Preprocessing

    def build(self, logs: Sequence[ProcessedLog], base: BaseMap) -> Problem:
        """The problem W beta = b of all rows of the logs."""
        rows = self.unknowns.rows
        names = self.unknowns.robot.torque_rows
        kinds = tuple(self.unknowns.robot.torque_kinds[names.index(row)] for row in rows)
        parts = [self._factors(log) for log in logs]
        factors = tuple(merge_factors(of_row) for of_row in zip(*parts, strict=True))
        return Problem(
            parameters=self.unknowns.parameters,
            base=base,
            rows=rows,
            factors=factors,
            bodies=self.unknowns.bodies,
            blocks=partial(_blocks, self, tuple(logs)),
            samples=sum(len(log.recording) for log in logs),
            kinds=kinds,
            torque=np.array([self._rms_torque(logs, row) for row in rows]),
            # Motions of several logs differ: their spread is more than that of the noise.
            period=logs[0].recording.motion.period_samples if len(logs) == 1 else 0,
        )

    def regression(self, log: ProcessedLog) -> tuple[AnyRegression, Array]:
        """The regression of the columns that act in a log, and their indices among all (k,)."""
        known = set(self.unknowns.robot_parameters) | (
            set(self.unknowns.payload_parameters) if log.payload else set()
        )
        indices = [i for i, name in enumerate(self.columns) if name in known]
        robot = (
            log.robot if self.unknowns.loaded is not None and log.payload else self.unknowns.robot
        )
        return torque_regression(robot, [self.columns[i] for i in indices]), np.array(indices)

    def torque(self, log: ProcessedLog) -> Array:
        """Measured torque (N, n) minus that of a known payload."""
        tau, load = log.recording.tau, log.robot.payload_body
        if load is None or self.unknowns.loaded is not None:
            return tau
        regression = torque_regression(log.robot, log.robot.bodies[load].columns)
        return np.asarray(tau - regression.torque(log.recording.motion, log.robot.phi[load]))

    def _factors(self, log: ProcessedLog) -> list[Factor]:
        (factors,) = self.factors(log, np.zeros(len(log.recording), dtype=int), 1)
        return factors

    def factors(self, log: ProcessedLog, labels: Array, count: int) -> list[list[Factor]]:
        """For each label 0 ... count - 1 the factors of all joints at samples that have it (N,),
        in one pass over the motion."""
        regression, indices = self.regression(log)
        rows = [regression.rows.index(row) for row in self.unknowns.rows]
        extra = [self.extra_columns(log, row) for row in self.unknowns.rows]
        moving = [self._moving_rows(log, row) for row in self.unknowns.rows]
        columns = [
            np.concatenate([indices[regression.touched[i]], of_extra])
            for i, (_, of_extra) in zip(rows, extra, strict=True)
        ]
        Rs = [[np.zeros((0, len(of_row) + 1)) for of_row in columns] for _ in range(count)]
        tau = self.torque(log)
        for block in regression.blocks(log.recording.motion):
            part = block.samples
            for k, i in enumerate(rows):
                Wb = np.column_stack([block.row(i).T, extra[k][0][part], tau[part, i]])
                for label in range(count):
                    used = moving[k][part] & (labels[part] == label)
                    if used.any():
                        Rs[label][k] = upper_factor([Rs[label][k], Wb[used]])
        return [
            [
                Factor(row, columns[k], Rs[label][k], int((moving[k] & (labels == label)).sum()))
                for k, row in enumerate(self.unknowns.rows)
            ]
            for label in range(count)
        ]

    def motors(self, motion: Trajectory) -> Trajectory | None:
        """Motion of the motors along a motion of the robot."""
        features = self.unknowns.features
        return None if features is None else features.motors_of(self.unknowns.robot, motion)

    def extra_columns(self, log: ProcessedLog, row: str) -> tuple[Array, Array]:
        """Feature columns (N, k) of one joint, and their indices among all."""
        names, values = self.features(row, log.recording.motion, log.motors)
        if self.unknowns.given and log.payload:
            i = log.robot.torque_rows.index(row)
            values = np.column_stack([values, _torque_per_kilogram(log)[:, i]])
            names = [*names, MASS]
        return values, np.array([self.columns.index(name) for name in names], dtype=int)

    def features(
        self, row: str, motion: Trajectory, motors: Trajectory | None
    ) -> tuple[list[str], Array]:
        """Names of the features on one joint's row, and their values (N, k)."""
        if self.unknowns.features is None:
            return [], np.zeros((len(motion), 0))
        chosen = [name for name in self.unknowns.extra if name in self.columns]
        return self.unknowns.features.on_row(row, chosen, motion, motors)

    def _rms_torque(self, logs: Sequence[ProcessedLog], row: str) -> float:
        """RMS of the measured torque of a joint, known parts included."""
        parts = [
            log.recording.tau[self._moving_rows(log, row), log.robot.torque_rows.index(row)]
            for log in logs
        ]
        tau = np.concatenate(parts)
        return float(np.sqrt((tau**2).mean())) if len(tau) else 0.0

    def _moving_rows(self, log: ProcessedLog, row: str) -> Array:
        """Samples (N,) at which a joint moves fast enough."""
        v = log.recording.motion.v[:, log.robot.rows.index(row)]
        return np.asarray(np.abs(v) >= self.preprocessing.moving)


def fold_factors(
    builder: LogProblemBuilder, logs: Sequence[ProcessedLog], count: int
) -> list[list[tuple[Factor, ...]]]:
    """For each part and each joint the factors of all logs."""
    log_factors = [
        builder.factors(log, time_folds(log.recording.motion, count)[0], count) for log in logs
    ]
    rows = range(len(builder.unknowns.rows))
    return [[tuple(factors[f][k] for factors in log_factors) for k in rows] for f in range(count)]


def merge_factors(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several logs, which may have different columns."""
    if len(factors) == 1:
        return factors[0]
    columns = np.unique(np.concatenate([factor.columns for factor in factors]))
    padded = []
    for factor in factors:
        R = np.zeros((len(factor.R), len(columns) + 1))
        R[:, np.searchsorted(columns, factor.columns)] = factor.R[:, :-1]
        R[:, -1] = factor.R[:, -1]
        padded.append(R)
    return Factor(factors[0].row, columns, upper_factor(padded), sum(f.samples for f in factors))


def _blocks(builder: LogProblemBuilder, logs: tuple[ProcessedLog, ...]) -> Iterator[RowBlock]:
    """Dense rows W, b; those of joints that move too slowly are zero."""
    for log in logs:
        regression, indices = builder.regression(log)
        tau, motion = builder.torque(log), log.recording.motion
        rows = [regression.rows.index(row) for row in builder.unknowns.rows]
        moving = np.stack([builder._moving_rows(log, row) for row in builder.unknowns.rows], axis=1)
        features = [builder.extra_columns(log, row) for row in builder.unknowns.rows]
        for block in regression.blocks(motion):
            W = np.zeros((block.count, len(rows), len(builder.columns)))
            W[:, :, indices] = block.dense()[:, rows]
            for i, (values, columns) in enumerate(features):
                W[:, i, columns] = values[block.samples]
            kept = moving[block.samples]
            yield W * kept[:, :, None], tau[block.samples][:, rows] * kept


def _torque_per_kilogram(log: ProcessedLog) -> Array:
    """Torque (N, n) of the payload of a log per kilogram."""
    body = log.robot.payload_body
    assert body is not None
    regression = torque_regression(log.robot, log.robot.bodies[body].columns)
    per_kilogram = log.robot.phi[body] / log.payload.mass
    return np.asarray(regression.torque(log.recording.motion, per_kilogram))


def regressor_blocks(builder: LogProblemBuilder, motion: Trajectory) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion of the unloaded robot."""
    known = [
        i for i, name in enumerate(builder.columns) if name in builder.unknowns.robot_parameters
    ]
    regression = torque_regression(builder.unknowns.robot, [builder.columns[i] for i in known])
    rows = [regression.rows.index(row) for row in builder.unknowns.rows]
    features = [
        builder.features(row, motion, builder.motors(motion)) for row in builder.unknowns.rows
    ]
    for block in regression.blocks(motion):
        W = np.zeros((block.count, len(rows), len(builder.columns)))
        W[:, :, known] = block.dense()[:, rows]
        for i, (names, values) in enumerate(features):
            W[:, i, [builder.columns.index(name) for name in names]] = values[block.samples]
        yield W


def predict_torque(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Measured and predicted torque (N, rows) of a problem's rows."""
    pairs = [(b, W @ beta) for W, b in problem.blocks()]
    return np.concatenate([b for b, _ in pairs]), np.concatenate([w for _, w in pairs])
