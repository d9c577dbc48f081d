"""Logs become problems: what is asked, row by row, folded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.experiments.recorded.preprocess import Preprocessing, ProcessedLog
from sysid_bench.experiments.recorded.unknowns import MASS, Unknowns
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.signals.time_folds import time_folds
from sysid_bench.types import Array, Factor, Problem, RowBlock, Trajectory


@dataclass(frozen=True, eq=False)
class LogProblemBuilder:
    """Logs become problems in the base parameters named `columns`."""

    unknowns: Unknowns
    columns: tuple[str, ...]
    preprocessing: Preprocessing

    def build(self, logs: Sequence[ProcessedLog], base: Any) -> Problem:
        """W beta = b of all rows of some logs."""
        rows = self.unknowns.rows
        names = self.unknowns.robot.torque_rows
        kinds = tuple(self.unknowns.robot.torque_kinds[names.index(row)] for row in rows)
        parts = [self._factors(log) for log in logs]
        factors = tuple(merge_factors(own) for own in zip(*parts, strict=True))
        return Problem(
            parameters=self.unknowns.parameters,
            base=base,
            rows=rows,
            factors=factors,
            bodies=self.unknowns.bodies,
            blocks=partial(_blocks, self, tuple(logs)),
            samples=sum(len(log.recording) for log in logs),
            kinds=kinds,
            torque=np.array([self._whole(logs, row) for row in rows]),
            # Motions of several logs differ: their spread is more than that of the noise.
            period=logs[0].recording.motion.period_samples if len(logs) == 1 else 0,
        )

    def regression(self, log: ProcessedLog) -> tuple[AnyRegression, Array]:
        """The regression of the columns that a log knows, and their places among all (k,)."""
        known = set(self.unknowns.robot_parameters) | (
            set(self.unknowns.payload_parameters) if log.payload else set()
        )
        places = [i for i, name in enumerate(self.columns) if name in known]
        robot = (
            log.robot if self.unknowns.loaded is not None and log.payload else self.unknowns.robot
        )
        return torque_regression(robot, [self.columns[i] for i in places]), np.array(places)

    def torque(self, log: ProcessedLog) -> Array:
        """Measured torque (N, n) less that of a known payload."""
        tau, load = log.recording.tau, log.robot.payload_body
        if load is None or self.unknowns.loaded is not None:
            return tau
        columns = torque_regression(log.robot, log.robot.bodies[load].columns)
        return tau - columns.torque(log.recording.motion, log.robot.phi[load])

    def _factors(self, log: ProcessedLog) -> list[Factor]:
        (factors,) = self.factors(log, np.zeros(len(log.recording), dtype=int), 1)
        return factors

    def factors(self, log: ProcessedLog, labels: Array, count: int) -> list[list[Factor]]:
        """For each label 0 ... count - 1 the factors of all joints at samples that have it (N,),
        in one pass over the motion."""
        columns, places = self.regression(log)
        motion, tau = log.recording.motion, self.torque(log)
        at = [columns.rows.index(row) for row in self.unknowns.rows]
        extra = [self.extra_columns(log, row) for row in self.unknowns.rows]
        moving = [self.moving_rows(log, row) for row in self.unknowns.rows]
        widths = [len(columns.touched[i]) + len(x[1]) + 1 for i, x in zip(at, extra, strict=True)]
        Rs = [[np.zeros((0, width)) for width in widths] for _ in range(count)]
        for block in columns.blocks(motion):
            part = block.samples
            for k, i in enumerate(at):
                both = np.column_stack([block.row(i).T, extra[k][0][part], tau[part, i]])
                for label in range(count):
                    chosen = moving[k][part] & (labels[part] == label)
                    if chosen.any():
                        Rs[label][k] = upper_factor([Rs[label][k], both[chosen]])
        touched = [
            np.concatenate([places[columns.touched[i]], own])
            for i, (_, own) in zip(at, extra, strict=True)
        ]
        return [
            [
                Factor(row, touched[k], Rs[label][k], int((moving[k] & (labels == label)).sum()))
                for k, row in enumerate(self.unknowns.rows)
            ]
            for label in range(count)
        ]

    def motors(self, motion: Trajectory) -> Trajectory | None:
        """Where the motors are along a motion of the robot."""
        features = self.unknowns.features
        return None if features is None else features.motors_of(self.unknowns.robot, motion)

    def extra_columns(self, log: ProcessedLog, row: str) -> tuple[Array, Array]:
        """Feature columns (N, k) of one joint, and their places among all."""
        names, values = self.features(row, log.recording.motion, log.motors)
        if self.unknowns.given and log.payload:
            i = log.robot.torque_rows.index(row)
            values = np.column_stack([values, _torque_of_a_kilogram(log)[:, i]])
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

    def _whole(self, logs: Sequence[ProcessedLog], row: str) -> float:
        """RMS of the measured torque of a joint, what is known of it included."""
        used = [
            log.recording.tau[self.moving_rows(log, row), log.robot.torque_rows.index(row)]
            for log in logs
        ]
        every = np.concatenate(used)
        return float(np.sqrt((every**2).mean())) if len(every) else 0.0

    def moving_rows(self, log: ProcessedLog, row: str) -> Array:
        """Samples (N,) at which a joint moves fast enough."""
        v = log.recording.motion.v[:, log.robot.rows.index(row)]
        return np.abs(v) >= self.preprocessing.moving


def fold_factors(
    posing: "LogProblemBuilder", logs: Sequence[ProcessedLog], count: int
) -> list[list[tuple[Factor, ...]]]:
    """For each part and each joint the factors of all logs."""
    of_logs = [
        posing.factors(log, time_folds(log.recording.motion, count)[0], count) for log in logs
    ]
    rows = range(len(posing.unknowns.rows))
    return [[tuple(own[f][k] for own in of_logs) for k in rows] for f in range(count)]


def merge_factors(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several logs, which may touch different columns."""
    if len(factors) == 1:
        return factors[0]
    columns = np.unique(np.concatenate([factor.columns for factor in factors]))
    wide = []
    for factor in factors:
        R = np.zeros((len(factor.R), len(columns) + 1))
        R[:, np.searchsorted(columns, factor.columns)] = factor.R[:, :-1]
        R[:, -1] = factor.R[:, -1]
        wide.append(R)
    return Factor(factors[0].row, columns, upper_factor(wide), sum(f.samples for f in factors))


def _blocks(posing: LogProblemBuilder, logs: tuple[ProcessedLog, ...]) -> Iterator[RowBlock]:
    """The rows themselves; those of joints that hardly move are zero."""
    for log in logs:
        columns, places = posing.regression(log)
        tau, motion = posing.torque(log), log.recording.motion
        at = [columns.rows.index(row) for row in posing.unknowns.rows]
        moving = np.stack([posing.moving_rows(log, row) for row in posing.unknowns.rows], axis=1)
        features = [posing.extra_columns(log, row) for row in posing.unknowns.rows]
        for block in columns.blocks(motion):
            W = np.zeros((block.count, len(at), len(posing.columns)))
            W[:, :, places] = block.dense()[:, at]
            for i, (values, own) in enumerate(features):
                W[:, i, own] = values[block.samples]
            kept = moving[block.samples]
            yield W * kept[:, :, None], tau[block.samples][:, at] * kept


def _torque_of_a_kilogram(log: ProcessedLog) -> Array:
    """Torque (N, n) of the log's payload per kg."""
    body = log.robot.payload_body
    assert body is not None
    columns = torque_regression(log.robot, log.robot.bodies[body].columns)
    return columns.torque(log.recording.motion, log.robot.phi[body] / log.payload.mass)


def regressor_blocks(posing: LogProblemBuilder, motion: Trajectory) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion of the unloaded robot."""
    known = [i for i, name in enumerate(posing.columns) if name in posing.unknowns.robot_parameters]
    columns = torque_regression(posing.unknowns.robot, [posing.columns[i] for i in known])
    at = [columns.rows.index(row) for row in posing.unknowns.rows]
    features = [posing.features(row, motion, posing.motors(motion)) for row in posing.unknowns.rows]
    for block in columns.blocks(motion):
        W = np.zeros((block.count, len(at), len(posing.columns)))
        W[:, :, known] = block.dense()[:, at]
        for i, (names, values) in enumerate(features):
            W[:, i, [posing.columns.index(name) for name in names]] = values[block.samples]
        yield W


def predict_torque(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Measured and predicted torque (N, rows) of a problem's rows."""
    pairs = [(b, W @ beta) for W, b in problem.blocks()]
    return np.concatenate([b for b, _ in pairs]), np.concatenate([w for _, w in pairs])
