"""Regressor of a robot with coupled joints: Y_reduced = G(q)^T Y_tree.

With v = G(q) v_ind on the closed mechanism, the principle of virtual work maps the rows of
dependent joints onto the independent ones. Rows are formed block by block, as for a tree.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.coupling.pullback import Slopes, pullback_follow
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import Measured
from sysid_bench.models.tree import Tree
from sysid_bench.regressors import kernel_pullback
from sysid_bench.regressors.kernel_layout import dense_rows
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.regression import Block, Regression, regression
from sysid_bench.types import Array, Regressor, Trajectory


@dataclass(frozen=True, eq=False)
class CoupledRegression:
    """Regressor Y (N, n, p) of the independent joints, along motions that satisfy the closure."""

    tree: Regression
    coupling: Coupling

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the independent degrees of freedom (n,)."""
        return tuple(self.tree.rows[dof] for dof in self.tree_rows)

    @cached_property
    def tree_rows(self) -> Array:
        """Indices (n,) of the rows in the tree's regressor: independent joints, then the rows of
        sensors, which follow all joints and take part in no coupling."""
        joints = len(self.coupling.independent) + len(self.coupling.dependent)
        return np.concatenate([self.coupling.independent, np.arange(joints, len(self.tree.rows))])

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters (p,)."""
        return self.tree.columns

    @cached_property
    def _dependent_rows(self) -> tuple[tuple[int, ...], ...]:
        """For each row, the indices among the dependent joints of those that act on it."""
        return tuple(
            tuple(int(d) for d in np.flatnonzero(column)) for column in self.coupling.is_coupled.T
        ) + ((),) * (len(self.tree_rows) - len(self.coupling.independent))

    @cached_property
    def row_columns(self) -> tuple[Array, ...]:
        """Indices (k,) of the columns in which each row can be non-zero, as `row` orders them."""
        touched = []
        for dof, sources in zip(self.tree_rows, self._dependent_rows, strict=True):
            direct = self.tree.row_columns[dof]
            others = [self.tree.row_columns[self.coupling.dependent[d]] for d in sources]
            new = np.setdiff1d(np.concatenate(others), direct) if others else direct[:0]
            touched.append(np.concatenate([direct, new]))
        return tuple(touched)

    def blocks(self, motion: Trajectory) -> Iterator["CoupledBlock"]:
        """Yield Y of consecutive samples, in blocks that fit the cache."""
        # Sensors are modelled as joints that never move; their coordinates follow the robot's.
        sensor_rows = len(self.tree_rows) - len(self.coupling.independent)
        for block in self.tree.blocks(motion):
            q = motion.q[block.samples, : motion.q.shape[1] - sensor_rows]
            yield CoupledBlock(self, block, self.coupling.follow(q))

    def dense(self, motion: Trajectory) -> Regressor:
        """Return Y (N, n, p) with its zeros; for short motions and for comparisons."""
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
        """Slice of the motion's samples that the block holds."""
        return self.tree.samples

    @property
    def count(self) -> int:
        """Number n of samples."""
        return self.tree.count

    def row(self, i: int, out: Array | None = None) -> Array:
        """Return row i of Y, (k, n), in the columns `touched[i]`; into `out` if it is given."""
        regression, coupling = self.regression, self.regression.coupling
        touched = regression.row_columns[i]
        if out is None:
            out = np.empty((len(touched), self.count))
        tree_row = int(regression.tree_rows[i])
        size = len(regression.tree.row_columns[tree_row])
        self.tree.row(tree_row, out[:size])
        out[size:] = 0.0
        index = np.empty(len(regression.columns), dtype=int)
        index[touched] = np.arange(len(touched))
        for d in regression._dependent_rows[i]:
            dof = int(coupling.dependent[d])
            # Virtual work: a dependent row acts with its rate per unit rate of the independent
            # joint.
            out[index[regression.tree.row_columns[dof]]] += self.F[:, d, i] * self.tree.row(dof)
        return out

    def row_with(self, i: int, b: Array) -> Array:
        """Return row i with a right-hand side b (n,) below it, (k + 1, n)."""
        out = np.empty((len(self.regression.row_columns[i]) + 1, self.count))
        self.row(i, out[:-1])
        out[-1] = b
        return out

    def dense(self) -> Array:
        """Return Y (n, rows, p) with its zeros."""
        shape = (self.count, len(self.regression.rows), len(self.regression.columns))
        return dense_rows(map(self.row, range(shape[1])), self.regression.row_columns, shape)


AnyRegression = Regression | CoupledRegression


def torque_regression(
    robot: RobotModel, columns: Sequence[str], measured: Measured | None = None
) -> AnyRegression:
    """Return the regression of a robot's measured torques on the parameters named in `columns`.

    Rows are `robot.torque_rows`, then those of the sensors in `measured`. Raises UsageError for an
    unknown name.
    """
    tree = regression(robot, columns, measured)
    return tree if robot.coupling is None else CoupledRegression(tree, robot.coupling)


def smooth_regression(regression: AnyRegression) -> AnyRegression:
    """Return the regression with tanh(v / SMOOTH_RATE) in place of sign(v) in Coulomb friction."""
    if isinstance(regression, CoupledRegression):
        return replace(regression, tree=kernel_pullback.smooth_regression(regression.tree))
    return kernel_pullback.smooth_regression(regression)


def pullback(regression: AnyRegression, motion: Trajectory, G: Array) -> Slopes:
    """Return the derivatives of sum(G * Y) by q, v and a of the tree, (N, nv) each; G (N, rows,
    p) weights the entries of Y."""
    if not isinstance(regression, CoupledRegression):
        return kernel_pullback.pullback(regression, motion, G)
    coupling, tree = regression.coupling, regression.tree
    moving = len(coupling.independent)
    weights = np.zeros((len(motion), len(tree.rows), len(tree.columns)))
    weights[:, regression.tree_rows] = G
    followed = np.einsum("ndi,nip->ndp", coupling.follow(motion.q), G[:, :moving])
    weights[:, coupling.dependent] += followed
    q, v, a = kernel_pullback.pullback(tree, motion, weights)
    if not coupling.linear:
        # F(q) multiplies the dependent rows: its own derivative adds a term; constant F has none.
        Y = tree.dense(motion).Y[:, coupling.dependent]
        by_closure = pullback_follow(coupling, motion, np.einsum("ndp,nip->ndi", Y, G[:, :moving]))
        q[:, : by_closure.shape[1]] += by_closure
    return q, v, a


def pullback_torque(
    tree: Tree, coupling: Coupling | None, phi: Array, motion: Trajectory, U: Array
) -> Slopes:
    """Return the derivatives of sum(U * tau) by q, v and a of the tree, (N, nv) each.

    U (N, n) weights tau (N, n), the rigid-body torque on the independent joints of links with
    parameters phi (n_links, 10).
    """
    if coupling is None:
        return kernel_pullback.pullback_torque(tree, phi, motion, U)
    whole = np.einsum("nij,nj->ni", coupling.G(motion.q), U)
    q, v, a = kernel_pullback.pullback_torque(tree, phi, motion, whole)
    if not coupling.linear:
        tau = newton_euler(tree, phi, motion)[:, coupling.dependent]
        q += pullback_follow(coupling, motion, tau[:, :, None] * U[:, None])
    return q, v, a
