"""Models that excitation design evaluates along a motion: base regressor of a task, and torques."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import SensorSubtree, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.regressors.coupled import (
    AnyRegression,
    pullback,
    pullback_torque,
    smooth_regression,
    torque_regression,
)
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class InformationModel:
    """Base regressor of a task: `columns` of `regression` at its `measured` rows.

    `instrumented` adds the degrees of freedom of force sensors to a motion.
    """

    regression: AnyRegression
    measured: tuple[int, ...]
    columns: tuple[int, ...]
    instrumented: Callable[[Trajectory], Trajectory] = lambda motion: motion

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters (r,)."""
        return tuple(self.regression.columns[c] for c in self.columns)

    def rows(self, motion: Trajectory) -> Array:
        """Return Y (N, rows, r) in SI."""
        rows, columns = list(self.measured), list(self.columns)
        blocks = self.regression.blocks(self.instrumented(motion))
        return np.concatenate([block.dense()[:, rows][:, :, columns] for block in blocks])

    def gradient(self, motion: Trajectory, G: Array) -> Slopes:
        """Return derivatives of sum(G * Y) by q, v, a (N, nv); G (N, rows, r)."""
        whole = np.zeros((len(motion), len(self.regression.rows), len(self.regression.columns)))
        rows, columns = np.ix_(self.measured, self.columns)
        whole[:, rows, columns] = G
        q, v, a = pullback(self.regression, self.instrumented(motion), whole)
        nv = motion.v.shape[1]  # sensors come after all joints
        return q[:, :nv], v[:, :nv], a[:, :nv]

    def select_columns(self, names: tuple[str, ...]) -> "InformationModel":
        """Return the same model of some of its base parameters."""
        return replace(self, columns=tuple(self.regression.columns.index(name) for name in names))

    @cached_property
    def smooth(self) -> "InformationModel":
        """Same model with a smooth sign(v), differentiable for a search."""
        return replace(self, regression=smooth_regression(self.regression))


@dataclass(frozen=True, eq=False)
class TorqueModel:
    """Torques of the independent joints by known parameters: `theta` (p,) of `regression`, and
    inertial parameters `links` (n_links, 10) of the tree."""

    regression: AnyRegression
    theta: Array
    links: Array
    tree: Tree
    coupling: Coupling | None = None

    def of(self, motion: Trajectory) -> Array:
        """Return tau (N, n) in N m or N."""
        tau = newton_euler(self.tree, self.links, motion)
        if self.coupling is not None:
            tau = self.coupling.reduced(motion.q, tau)
        return np.asarray(tau + self.regression.torque(motion, self.theta))

    def gradient(self, motion: Trajectory, U: Array) -> Slopes:
        """Return derivatives of sum(U * tau) by q, v, a (N, nv); U (N, n)."""
        parts = [pullback_torque(self.tree, self.coupling, self.links, motion, U)]
        if self.theta.any():
            parts.append(pullback(self.regression, motion, U[:, :, None] * self.theta))
        q, v, a = (sum(part) for part in zip(*parts, strict=True))
        return q, v, a


def information_model(
    robot: RobotModel,
    base_names: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorSubtree, ...] = (),
) -> InformationModel:
    """Return the regressor of the base parameters named.

    `rows`: measured torques and wrench components (None: torques of all independent joints, and
    all components of the force sensors `cuts`).
    """
    instruments = instruments_of(robot, cuts)
    names = instruments.measured if rows is None else rows
    measured = tuple(instruments.measured.index(row) for row in names)
    regression = torque_regression(robot, base_names, instruments)
    columns = tuple(range(len(base_names)))
    return InformationModel(regression, measured, columns, instruments.motion)


def torque_model(robot: RobotModel) -> TorqueModel:
    """Return the torque model by the parameters in the robot's own file, payload included."""
    between = np.argwhere(robot.joint_terms.viscous_coupling)
    terms = (*SUFFIX, *(f"{robot.rows[i]}.fv.{robot.rows[j]}" for i, j in between))
    columns = torque_regression(robot, robot.term_columns(terms))
    links = robot.tree.link_parameters(robot.phi)
    return TorqueModel(columns, robot.term_values(terms), links, robot.tree, robot.coupling)
