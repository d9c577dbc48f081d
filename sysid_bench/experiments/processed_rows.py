"""Rows W beta = b of a motion as a pipeline leaves them, and those of several motions together."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Protocol

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.numerics import qr_factor
from sysid_bench.signals.row_processing import RowProcessing
from sysid_bench.signals.spectrum import repetition
from sysid_bench.types import Array, Factor, Problem, RowBlock, Trajectory

BLOCK: Final = 512
"""Samples of a dense block: a few megabytes for an arm."""


class RegressorBlock(Protocol):
    """The part of a block of a regressor that is read here."""

    @property
    def samples(self) -> slice: ...
    def row(self, i: int) -> Array: ...


@dataclass(frozen=True, eq=False)
class MotionRows:
    """Processing of the rows of one motion at `rate` (Hz), with the weights (N, rows) of its
    samples."""

    processing: RowProcessing
    weights: Array
    rate: float

    @property
    def is_processed(self) -> bool:
        """False where rows are those of the samples, those of weight 0 left out."""
        return not self.processing.is_plain

    @property
    def samples(self) -> int:
        """Number M of processed samples."""
        return len(range(0, len(self.weights), self.processing.step))

    def period(self, motion: Trajectory) -> int:
        """Processed samples per period of the motion; 0 where it is not periodic."""
        return sampled_motion(motion, self.processing.step).period_samples

    def repetition(self, motion: Trajectory) -> float:
        """Processed samples after which the positions of the motion repeat, declared or not; 0
        where they do not. It is not a period for intervals: what repeats may not have been the same
        command."""
        return repetition(motion) / self.processing.step

    def processed(self, x: Array) -> Array:
        """Values x (N, rows, ...) of each row as processed, (M, rows, ...)."""
        parts = [self.of_row(i, x[:, i].reshape(len(x), -1)) for i in range(x.shape[1])]
        return np.stack(parts, axis=1).reshape(-1, *x.shape[1:])

    def of_row(self, i: int, x: Array) -> Array:
        """Columns x (N, k) of row i as processed, (M, k)."""
        return self.processing.apply(x, self.weights[:, i], self.rate)

    def row_values(self, i: int, x: Array) -> Array:
        """Values x (N,) of row i as processed, without those left out where rows are samples."""
        if self.is_processed:
            return self.of_row(i, x[:, None])[:, 0]
        return x[self.weights[:, i] > 0]

    def count(self, i: int, chosen: Array | slice = slice(None)) -> int:
        """Processed rows that the `chosen` samples of row i amount to."""
        return self.processing.count(self.weights[chosen, i])

    def rms(self, measured: Array) -> Array:
        """RMS (rows,) of measured signals (N, rows) as processed, over the rows that count."""
        squares = [float((self.row_values(i, x) ** 2).sum()) for i, x in enumerate(measured.T)]
        counts = [max(self.count(i), 1) for i in range(len(squares))]
        return np.sqrt(np.array(squares) / counts)

    def mean(self, measured: Array) -> Array:
        """Mean (rows,) of the same."""
        sums = [float(self.row_values(i, x).sum()) for i, x in enumerate(measured.T)]
        return np.array([total / max(self.count(i), 1) for i, total in enumerate(sums)])

    @property
    def left_out(self) -> float:
        """Share of the rows of all joints that are left out."""
        return float((self.weights == 0.0).mean()) if self.weights.size else 0.0


def sampled_motion(motion: Trajectory, step: int) -> Trajectory:
    """Every `step`-th sample of a motion."""
    part = slice(None, None, step)
    return replace(motion, t=motion.t[part], q=motion.q[part], v=motion.v[part], a=motion.a[part])


def motion_rows(
    processing: RowProcessing, robot: RobotModel, rows: Sequence[str], motion: Trajectory
) -> MotionRows:
    """The processing of the named rows along a motion of a robot.

    Only hinges and slides stand still: rows of a floating base, of a ball joint and of sensors
    have full weight.
    """
    rates = np.full((len(motion), len(rows)), np.nan)
    scalar = {robot.rows[dof]: dof for dof in robot.scalar_dofs}
    for i, row in enumerate(rows):
        if row in scalar:
            rates[:, i] = motion.v[:, scalar[row]]
    # Samples are uniform; a single one has no rate.
    rate = (len(motion) - 1) / float(motion.t[-1] - motion.t[0]) if len(motion) > 1 else 1.0
    return MotionRows(processing, processing.weights(rates), rate)


def row_samples(
    blocks: Iterable[RegressorBlock], index: int, tau: Array, extra: Array | None = None
) -> Array:
    """[W_i | b_i] (N, k + 1) of one row of a regressor from the blocks of a motion, further columns
    `extra` (N, k') behind those of the regressor."""
    parts = []
    for block in blocks:
        columns = [block.row(index).T, tau[block.samples]]
        if extra is not None:
            columns.insert(1, extra[block.samples])
        parts.append(np.column_stack(columns))
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class ProcessedRows:
    """[W_i | b_i] (M, k + 1) of each row as processed, and the indices (k,) of its columns among
    all `size`."""

    rows: tuple[str, ...]
    columns: tuple[Array, ...]
    values: tuple[Array, ...]
    along: MotionRows
    size: int

    @property
    def factors(self) -> tuple[Factor, ...]:
        """R factor of each row."""
        (factors,) = self.factors_by_label(np.zeros(len(self.along.weights), dtype=int), 1)
        return tuple(factors)

    def factors_by_label(self, labels: Array, count: int) -> list[list[Factor]]:
        """For each label 0 ... count - 1 of samples (N,) the R factor of each row."""
        return [
            [self._factor(i, labels == label) for i in range(len(self.rows))]
            for label in range(count)
        ]

    def _factor(self, i: int, chosen: Array) -> Factor:
        """R factor of the processed samples among the `chosen` ones (N,)."""
        Wb = self.values[i][chosen[:: self.along.processing.step]]
        return Factor(self.rows[i], self.columns[i], qr_factor([Wb]), self.along.count(i, chosen))

    def blocks(self) -> Iterator[RowBlock]:
        """Yield W (n, rows, size) and b (n, rows); rows that are left out are zero."""
        for start in range(0, self.along.samples, BLOCK):
            part = [Wb[start : start + BLOCK] for Wb in self.values]
            W = np.zeros((len(part[0]), len(part), self.size))
            for i, (columns, Wb) in enumerate(zip(self.columns, part, strict=True)):
                W[:, i, columns] = Wb[:, :-1]
            yield W, np.stack([Wb[:, -1] for Wb in part], axis=1)


def pooled(problems: Sequence[Problem]) -> Problem:
    """Return the problem of all samples of some motions in order, which knows the single ones.

    All have the same unknowns and rows. The period is kept where all motions share it. One problem
    is returned as it is.
    """
    if len(problems) == 1:
        return problems[0]
    first, periods = problems[0], {problem.period for problem in problems}
    samples = sum(problem.samples for problem in problems)
    # RMS and mean of the whole torque over all motions; unknown where one does not state them.
    stated = [(p.samples, p.torque) for p in problems if p.torque is not None]
    means = [p.samples * p.mean for p in problems if p.mean is not None]
    torque, mean = None, None
    if len(stated) == len(problems):
        squares = np.sum([count * rms**2 for count, rms in stated], axis=0)
        torque = np.asarray(np.sqrt(squares / max(samples, 1)))
    if len(means) == len(problems):
        mean = np.asarray(np.sum(means, axis=0) / max(samples, 1))
    return replace(
        first,
        factors=tuple(row_factor(row) for row in zip(*(p.factors for p in problems), strict=True)),
        blocks=partial(_blocks, tuple(problems)),
        samples=samples,
        torque=torque,
        mean=mean,
        period=first.period if len(periods) == 1 else 0,
        motions=tuple(problems),
    )


def row_factor(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several recordings, which may have different columns."""
    if len(factors) == 1:
        return factors[0]
    columns = np.unique(np.concatenate([factor.columns for factor in factors]))
    padded = []
    for factor in factors:
        # Columns that a recording lacks are zero in it.
        R = np.zeros((len(factor.R), len(columns) + 1))
        R[:, np.searchsorted(columns, factor.columns)] = factor.R[:, :-1]
        R[:, -1] = factor.R[:, -1]
        padded.append(R)
    return Factor(factors[0].row, columns, qr_factor(padded), sum(f.samples for f in factors))


def _blocks(problems: tuple[Problem, ...]) -> Iterator[RowBlock]:
    for problem in problems:
        yield from problem.blocks()
