"""Y of a robot with coupled joints: rows of joints that follow act on those that move,
Y_reduced = G(q)^T Y_tree, row by row and block by block like the tree's own."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import Measured
from sysid_bench.regressors.regression import Block, Regression, regression
from sysid_bench.types import Array, Regressor, Trajectory


@dataclass(frozen=True, eq=False)
class CoupledRegression:
    """Y (N, n, p) of the independent joints, along motions that meet the closure."""

    tree: Regression
    coupling: Coupling

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the independent degrees of freedom (n,)."""
        return tuple(self.tree.rows[dof] for dof in self.places)

    @cached_property
    def places(self) -> Array:
        """The rows as places in the tree's: independent joints, then the sensors behind all joints,
        on which no joint acts as another would."""
        joints = len(self.coupling.independent) + len(self.coupling.dependent)
        return np.concatenate([self.coupling.independent, np.arange(joints, len(self.tree.rows))])

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters (p,)."""
        return self.tree.columns

    @cached_property
    def sources(self) -> tuple[tuple[int, ...], ...]:
        """For each row the dependent ones, as places among them, that act on it."""
        return tuple(
            tuple(int(d) for d in np.flatnonzero(column)) for column in self.coupling.depends_on.T
        ) + ((),) * (len(self.places) - len(self.coupling.independent))

    @cached_property
    def touched(self) -> tuple[Array, ...]:
        """For each row the places (k,) in Y that it can be non-zero in, as `Block.row` has them."""
        touched = []
        for dof, sources in zip(self.places, self.sources, strict=True):
            own = self.tree.touched[dof]
            others = [self.tree.touched[self.coupling.dependent[d]] for d in sources]
            new = np.setdiff1d(np.concatenate(others), own) if others else own[:0]
            touched.append(np.concatenate([own, new]))
        return tuple(touched)

    def blocks(self, motion: Trajectory) -> Iterator["CoupledBlock"]:
        """Y of consecutive samples, a cacheful at a time."""
        still = len(self.places) - len(self.coupling.independent)  # sensors are still joints
        for block in self.tree.blocks(motion):
            q = motion.q[block.samples, : motion.q.shape[1] - still]
            yield CoupledBlock(self, block, self.coupling.follow(q))

    def dense(self, motion: Trajectory) -> Regressor:
        """Y (N, n, p) at once: for small motions and witnesses."""
        parts = [block.dense() for block in self.blocks(motion)]
        return Regressor(np.concatenate(parts), self.rows, self.columns)

    def torque(self, motion: Trajectory, theta: Array) -> Array:
        """Y theta (N, n)."""
        return self.coupling.reduced(motion.q, self.tree.torque(motion, theta))


@dataclass(frozen=True, eq=False)
class CoupledBlock:
    """Y of the samples of one block of the tree; F (n, m, n_ind): v_dep = F v_ind."""

    regression: CoupledRegression
    tree: Block
    F: Array

    @property
    def samples(self) -> slice:
        """The samples of the motion that the block holds."""
        return self.tree.samples

    @property
    def count(self) -> int:
        """How many samples that are."""
        return self.tree.count

    def row(self, i: int, out: Array | None = None) -> Array:
        """Row i of Y, (k, n), in the columns `touched[i]`."""
        regression, coupling = self.regression, self.regression.coupling
        touched = regression.touched[i]
        if out is None:
            out = np.empty((len(touched), self.count))
        own = int(regression.places[i])
        size = len(regression.tree.touched[own])
        self.tree.row(own, out[:size])
        out[size:] = 0.0
        place = np.empty(len(regression.columns), dtype=int)
        place[touched] = np.arange(len(touched))
        for d in regression.sources[i]:
            dof = int(coupling.dependent[d])
            out[place[regression.tree.touched[dof]]] += self.F[:, d, i] * self.tree.row(dof)
        return out

    def joined(self, i: int, b: Array) -> Array:
        """Row i with a right-hand side b (n,) below it, (k + 1, n)."""
        out = np.empty((len(self.regression.touched[i]) + 1, self.count))
        self.row(i, out[:-1])
        out[-1] = b
        return out

    def dense(self) -> Array:
        """Y (n, rows, p) with its zeros."""
        Y = np.zeros((self.count, len(self.regression.rows), len(self.regression.columns)))
        for i, places in enumerate(self.regression.touched):
            Y[:, i, places] = self.row(i).T
        return Y


AnyRegression = Regression | CoupledRegression


def torque_regression(
    robot: RobotModel, columns: Sequence[str], measured: Measured | None = None
) -> AnyRegression:
    """The regression of a robot's measured torques, rows `robot.torque_rows` and those of sensors,
    on the parameters named in `columns`; raises UsageError for a name that it does not have."""
    tree = regression(robot, columns, measured)
    return tree if robot.coupling is None else CoupledRegression(tree, robot.coupling)
