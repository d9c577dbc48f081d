"""Logs become problems: what is asked, row by row, folded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sysid_bench.experiments.recorded.preprocess import Processed, Treatment
from sysid_bench.experiments.recorded.unknowns import MASS, Question
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.qr_accumulation import triangle
from sysid_bench.signals.time_folds import parts_of
from sysid_bench.types import Array, Factor, Problem, RowBlock, Trajectory


@dataclass(frozen=True, eq=False)
class Posing:
    """Logs become problems in the base parameters named `columns`."""

    ask: Question
    columns: tuple[str, ...]
    treatment: Treatment

    def pose(self, logs: Sequence[Processed], base: Any) -> Problem:
        """W beta = b of all rows of some logs."""
        rows = self.ask.rows
        names = self.ask.robot.torque_rows
        kinds = tuple(self.ask.robot.torque_kinds[names.index(row)] for row in rows)
        parts = [self._factors(log) for log in logs]
        factors = tuple(together(own) for own in zip(*parts, strict=True))
        return Problem(
            parameters=self.ask.parameters,
            base=base,
            rows=rows,
            factors=factors,
            bodies=self.ask.bodies,
            blocks=partial(_blocks, self, tuple(logs)),
            samples=sum(len(log.recording) for log in logs),
            kinds=kinds,
            torque=np.array([self._whole(logs, row) for row in rows]),
            # Motions of several logs differ: their spread is more than that of the noise.
            period=logs[0].recording.motion.period_samples if len(logs) == 1 else 0,
        )

    def regression(self, log: Processed) -> tuple[AnyRegression, Array]:
        """The regression of the columns that a log knows, and their places among all (k,)."""
        known = set(self.ask.own) | (set(self.ask.load) if log.payload else set())
        places = [i for i, name in enumerate(self.columns) if name in known]
        robot = log.robot if self.ask.loaded is not None and log.payload else self.ask.robot
        return torque_regression(robot, [self.columns[i] for i in places]), np.array(places)

    def torque(self, log: Processed) -> Array:
        """Measured torque (N, n) less that of a known payload."""
        tau, load = log.recording.tau, log.robot.payload_body
        if load is None or self.ask.loaded is not None:
            return tau
        columns = torque_regression(log.robot, log.robot.bodies[load].columns)
        return tau - columns.torque(log.recording.motion, log.robot.phi[load])

    def _factors(self, log: Processed) -> list[Factor]:
        (factors,) = self.factors(log, np.zeros(len(log.recording), dtype=int), 1)
        return factors

    def factors(self, log: Processed, labels: Array, count: int) -> list[list[Factor]]:
        """For each label 0 ... count - 1 the factors of all joints at samples that have it (N,),
        in one pass over the motion."""
        columns, places = self.regression(log)
        motion, tau = log.recording.motion, self.torque(log)
        at = [columns.rows.index(row) for row in self.ask.rows]
        extra = [self.extra(log, row) for row in self.ask.rows]
        moving = [self.moving(log, row) for row in self.ask.rows]
        widths = [len(columns.touched[i]) + len(x[1]) + 1 for i, x in zip(at, extra, strict=True)]
        Rs = [[np.zeros((0, width)) for width in widths] for _ in range(count)]
        for block in columns.blocks(motion):
            part = block.samples
            for k, i in enumerate(at):
                both = np.column_stack([block.row(i).T, extra[k][0][part], tau[part, i]])
                for label in range(count):
                    chosen = moving[k][part] & (labels[part] == label)
                    if chosen.any():
                        Rs[label][k] = triangle([Rs[label][k], both[chosen]])
        touched = [
            np.concatenate([places[columns.touched[i]], own])
            for i, (_, own) in zip(at, extra, strict=True)
        ]
        return [
            [
                Factor(row, touched[k], Rs[label][k], int((moving[k] & (labels == label)).sum()))
                for k, row in enumerate(self.ask.rows)
            ]
            for label in range(count)
        ]

    def motors(self, motion: Trajectory) -> Trajectory | None:
        """Where the motors are along a motion of the robot."""
        features = self.ask.features
        return None if features is None else features.motors_of(self.ask.robot, motion)

    def extra(self, log: Processed, row: str) -> tuple[Array, Array]:
        """Feature columns (N, k) of one joint, and their places among all."""
        names, values = self.features(row, log.recording.motion, log.motors)
        if self.ask.given and log.payload:
            i = log.robot.torque_rows.index(row)
            values = np.column_stack([values, _torque_of_a_kilogram(log)[:, i]])
            names = [*names, MASS]
        return values, np.array([self.columns.index(name) for name in names], dtype=int)

    def features(
        self, row: str, motion: Trajectory, motors: Trajectory | None
    ) -> tuple[list[str], Array]:
        """Names of the features on one joint's row, and their values (N, k)."""
        if self.ask.features is None:
            return [], np.zeros((len(motion), 0))
        chosen = [name for name in self.ask.extra if name in self.columns]
        return self.ask.features.on_row(row, chosen, motion, motors)

    def _whole(self, logs: Sequence[Processed], row: str) -> float:
        """RMS of the measured torque of a joint, what is known of it included."""
        used = [
            log.recording.tau[self.moving(log, row), log.robot.torque_rows.index(row)]
            for log in logs
        ]
        every = np.concatenate(used)
        return float(np.sqrt((every**2).mean())) if len(every) else 0.0

    def moving(self, log: Processed, row: str) -> Array:
        """Samples (N,) at which a joint moves fast enough."""
        v = log.recording.motion.v[:, log.robot.rows.index(row)]
        return np.abs(v) >= self.treatment.moving


def parts(
    posing: "Posing", logs: Sequence[Processed], count: int
) -> list[list[tuple[Factor, ...]]]:
    """For each part and each joint the factors of all logs."""
    of_logs = [posing.factors(log, parts_of(log.recording.motion, count)[0], count) for log in logs]
    rows = range(len(posing.ask.rows))
    return [[tuple(own[f][k] for own in of_logs) for k in rows] for f in range(count)]


def together(factors: Sequence[Factor]) -> Factor:
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
    return Factor(factors[0].row, columns, triangle(wide), sum(f.samples for f in factors))


def _blocks(posing: Posing, logs: tuple[Processed, ...]) -> Iterator[RowBlock]:
    """The rows themselves; those of joints that hardly move are zero."""
    for log in logs:
        columns, places = posing.regression(log)
        tau, motion = posing.torque(log), log.recording.motion
        at = [columns.rows.index(row) for row in posing.ask.rows]
        moving = np.stack([posing.moving(log, row) for row in posing.ask.rows], axis=1)
        features = [posing.extra(log, row) for row in posing.ask.rows]
        for block in columns.blocks(motion):
            W = np.zeros((block.count, len(at), len(posing.columns)))
            W[:, :, places] = block.dense()[:, at]
            for i, (values, own) in enumerate(features):
                W[:, i, own] = values[block.samples]
            kept = moving[block.samples]
            yield W * kept[:, :, None], tau[block.samples][:, at] * kept


def _torque_of_a_kilogram(log: Processed) -> Array:
    """Torque (N, n) of the log's payload per kg."""
    body = log.robot.payload_body
    assert body is not None
    columns = torque_regression(log.robot, log.robot.bodies[body].columns)
    return columns.torque(log.recording.motion, log.robot.phi[body] / log.payload.mass)


def regress(posing: Posing, motion: Trajectory) -> Iterator[Array]:
    """Blocks of the base regressor (n, rows, r) along any motion of the unloaded robot."""
    known = [i for i, name in enumerate(posing.columns) if name in posing.ask.own]
    columns = torque_regression(posing.ask.robot, [posing.columns[i] for i in known])
    at = [columns.rows.index(row) for row in posing.ask.rows]
    features = [posing.features(row, motion, posing.motors(motion)) for row in posing.ask.rows]
    for block in columns.blocks(motion):
        W = np.zeros((block.count, len(at), len(posing.columns)))
        W[:, :, known] = block.dense()[:, at]
        for i, (names, values) in enumerate(features):
            W[:, i, [posing.columns.index(name) for name in names]] = values[block.samples]
        yield W


def predicted(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Measured and predicted torque (N, rows) of a problem's rows."""
    pairs = [(b, W @ beta) for W, b in problem.blocks()]
    return np.concatenate([b for b, _ in pairs]), np.concatenate([w for _, w in pairs])
