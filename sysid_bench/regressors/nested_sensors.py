"""Y of a sensor whose sub-tree ends at other sensors that have constants of their own.

What such a sensor measures less what those measure is W phi + o - sum_s X_s(q) o_s: the constants
o_s are columns of its rows, moved there as their wrench is (see `handed_on`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import Instruments, SensorCut
from sysid_bench.regressors.coupled import AnyRegression, CoupledBlock, torque_regression
from sysid_bench.regressors.regression import Block
from sysid_bench.regressors.wrench import wrench_transform
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class NestedSensorRegressor:
    """The regression `whole` with the constants of `stops` in the rows of `cut`."""

    regression: AnyRegression
    instruments: Instruments
    cut: SensorCut
    distal: tuple[SensorCut, ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of what is measured."""
        return self.regression.rows

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters (p,)."""
        return self.regression.columns

    @cached_property
    def _components(self) -> dict[int, int]:
        """Row of the cut -> which of its six components that is."""
        return {self.rows.index(name): k for k, name in enumerate(self.cut.rows)}

    @cached_property
    def _constant_mask(self) -> Array:
        """Which of the stops' constants (6 stops,) are columns."""
        named = set(self.columns)
        return np.array([c in named for stop in self.distal for c in _constants_of(stop)])

    @cached_property
    def _constant_columns(self) -> Array:
        """Places in Y of the stops' constants that are columns."""
        names = np.array([c for stop in self.distal for c in _constants_of(stop)])[
            self._constant_mask
        ]
        return np.array([self.columns.index(name) for name in names], dtype=int)

    @cached_property
    def touched(self) -> tuple[Array, ...]:
        """For each row the places (k,) in Y that it can be non-zero in, as `row` has them."""
        return tuple(
            np.concatenate([places, self._constant_columns]) if i in self._components else places
            for i, places in enumerate(self.regression.touched)
        )

    def blocks(self, motion: Trajectory) -> Iterator["NestedSensorBlock"]:
        """Y of consecutive samples, along motions with the places of all sensors."""
        for block in self.regression.blocks(motion):
            X = [
                wrench_transform(self.instruments, _part(motion, block.samples), self.cut, stop)
                for stop in self.distal
            ]
            yield NestedSensorBlock(
                self, block, np.concatenate(X, axis=2)[..., self._constant_mask]
            )


@dataclass(frozen=True, eq=False)
class NestedSensorBlock:
    """The samples of one block; X (n, 6, k): unit constants of the stops, moved to the cut."""

    regression: NestedSensorRegressor
    block: Block | CoupledBlock
    X: Array

    @property
    def samples(self) -> slice:
        """The samples of the motion that the block holds."""
        return self.block.samples

    @property
    def count(self) -> int:
        """How many samples that are."""
        return self.block.count

    def row(self, i: int) -> Array:
        """Row i of Y, (k, n), in the columns `touched[i]`."""
        row = self.block.row(i)
        k = self.regression._components.get(i)
        return row if k is None else np.concatenate([row, -self.X[:, k].T])

    def augmented(self, i: int, b: Array) -> Array:
        """Row i with a right-hand side b (n,) below it, (k + 1, n)."""
        return np.concatenate([self.row(i), b[None]])

    def dense(self) -> Array:
        """Y (n, rows, p) with its zeros."""
        Y = np.zeros((self.count, len(self.regression.rows), len(self.regression.columns)))
        for i, places in enumerate(self.regression.touched):
            Y[:, i, places] = self.row(i).T
        return Y


MeasuredRegressor = AnyRegression | NestedSensorRegressor


def measured_regression(
    robot: RobotModel,
    columns: Sequence[str],
    instruments: Instruments,
    rows: Sequence[str] | None = None,
) -> MeasuredRegressor:
    """The regression of all that is measured on the parameters named in `columns`; constants of a
    sensor that is none of the measured `rows` act through the first one, which it ends."""
    whole = torque_regression(robot, columns, instruments)
    named = set(columns)
    stops = tuple(
        cut
        for cut in instruments.cuts[1:]
        if rows is not None and cut.rows[0] not in rows and named.intersection(_constants_of(cut))
    )
    return NestedSensorRegressor(whole, instruments, instruments.cuts[0], stops) if stops else whole


def _constants_of(cut: SensorCut) -> tuple[str, ...]:
    """Names of a sensor's six constants."""
    return tuple(f"{row}.{SUFFIX['offset']}" for row in cut.rows)


def _part(motion: Trajectory, samples: slice) -> Trajectory:
    return Trajectory(motion.t[samples], motion.q[samples], motion.v[samples], motion.a[samples])
