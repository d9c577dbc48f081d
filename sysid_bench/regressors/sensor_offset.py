"""Regressor of a force/torque sensor whose sub-tree ends at further, distal sensors with offsets.

The reading of such a sensor minus those of the distal ones is Y phi + o - sum_s X_s(q) o_s: the
offset o_s (6,) of distal sensor s is a column in its rows, transformed like a wrench by X_s (6, 6)
(`wrench.wrench_transform`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Instruments, SensorSubtree
from sysid_bench.regressors.coupled import AnyRegression, CoupledBlock, torque_regression
from sysid_bench.regressors.kernel_layout import dense_rows
from sysid_bench.regressors.kernel_numpy import motion_part
from sysid_bench.regressors.regression import Block
from sysid_bench.regressors.wrench import wrench_transform
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class SensorOffsetRegressor:
    """Regressor `regression` with the offsets of the `distal` sensors in the rows of `cut`."""

    regression: AnyRegression
    instruments: Instruments
    cut: SensorSubtree
    distal: tuple[SensorSubtree, ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the measured rows."""
        return self.regression.rows

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters (p,)."""
        return self.regression.columns

    @cached_property
    def _components(self) -> dict[int, int]:
        """Row index of each of the cut's six wrench components -> index of the component."""
        return {self.rows.index(name): k for k, name in enumerate(self.cut.rows)}

    @cached_property
    def _offset_mask(self) -> Array:
        """Mask (6 s,) of the s distal sensors' offsets that are columns of Y."""
        named = set(self.columns)
        return np.array([c in named for stop in self.distal for c in _offsets_of(stop)])

    @cached_property
    def _offset_columns(self) -> Array:
        """Indices in Y of the distal sensors' offsets that are columns of Y."""
        names = np.array([c for stop in self.distal for c in _offsets_of(stop)])[self._offset_mask]
        return np.array([self.columns.index(name) for name in names], dtype=int)

    @cached_property
    def row_columns(self) -> tuple[Array, ...]:
        """Indices (k,) of the columns in which each row can be non-zero, as `row` orders them."""
        return tuple(
            np.concatenate([touched, self._offset_columns]) if i in self._components else touched
            for i, touched in enumerate(self.regression.row_columns)
        )

    def blocks(self, motion: Trajectory) -> Iterator["SensorOffsetBlock"]:
        """Yield Y of consecutive samples, along motions with the coordinates of all sensors."""
        for block in self.regression.blocks(motion):
            X = [
                wrench_transform(
                    self.instruments, motion_part(motion, block.samples), self.cut, stop
                )
                for stop in self.distal
            ]
            yield SensorOffsetBlock(self, block, np.concatenate(X, axis=2)[..., self._offset_mask])

    def torque(self, motion: Trajectory, theta: Array) -> Array:
        """Y theta (N, rows)."""
        tau = np.empty((len(motion), len(self.rows)))
        for block in self.blocks(motion):
            for i, touched in enumerate(self.row_columns):
                tau[block.samples, i] = theta[touched] @ block.row(i)
        return tau


@dataclass(frozen=True, eq=False)
class SensorOffsetBlock:
    """Y of the samples of one block; X (n, 6, k): unit offsets of the distal sensors, transformed
    to the frame of the cut."""

    regression: SensorOffsetRegressor
    block: Block | CoupledBlock
    X: Array

    @property
    def samples(self) -> slice:
        """Slice of the motion's samples that the block holds."""
        return self.block.samples

    @property
    def count(self) -> int:
        """Number n of samples."""
        return self.block.count

    def row(self, i: int) -> Array:
        """Return row i of Y, (k, n), in the columns `touched[i]`."""
        row = self.block.row(i)
        k = self.regression._components.get(i)
        return row if k is None else np.concatenate([row, -self.X[:, k].T])

    def row_with(self, i: int, b: Array) -> Array:
        """Return row i with a right-hand side b (n,) below it, (k + 1, n)."""
        return np.concatenate([self.row(i), b[None]])

    def dense(self) -> Array:
        """Return Y (n, rows, p) with its zeros."""
        shape = (self.count, len(self.regression.rows), len(self.regression.columns))
        return dense_rows(map(self.row, range(shape[1])), self.regression.row_columns, shape)


MeasuredRegressor = AnyRegression | SensorOffsetRegressor
MeasuredBlock = Block | CoupledBlock | SensorOffsetBlock


def measured_regression(
    robot: RobotModel,
    columns: Sequence[str],
    instruments: Instruments,
    rows: Sequence[str] | None = None,
) -> MeasuredRegressor:
    """Return the regression of all measured rows on the parameters named in `columns`.

    Offsets of a sensor whose rows are not among the measured `rows` appear in the rows of the first
    sensor, whose sub-tree it ends. Raises UsageError for an unknown name.
    """
    tree = torque_regression(robot, columns, instruments)
    named = set(columns)
    distal = tuple(
        cut
        for cut in instruments.cuts[1:]
        if rows is not None and cut.rows[0] not in rows and named.intersection(_offsets_of(cut))
    )
    return SensorOffsetRegressor(tree, instruments, instruments.cuts[0], distal) if distal else tree


def _offsets_of(cut: SensorSubtree) -> tuple[str, ...]:
    """Names of a sensor's six offsets."""
    return tuple(f"{row}.{SUFFIX['offset']}" for row in cut.rows)
