"""What a designer may ask about a robot: the rows of a task's regressor, and torques."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_bench.models.coupling.coupling import Coupling
from sysid_bench.models.coupling.derivatives import Slopes
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import SensorCut, instruments_of
from sysid_bench.models.tree import Tree
from sysid_bench.regressors.coupled import AnyRegression, torque_regression
from sysid_bench.regressors.coupled_adjoint import pull_back, pull_back_torque, smoothed
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class InformationModel:
    """The base regressor of a task: the chosen `columns` of `regression` at the measured rows
    `places`; `seen` gives a motion the places of sensors."""

    regression: AnyRegression
    places: tuple[int, ...]
    columns: tuple[int, ...]
    seen: Callable[[Trajectory], Trajectory] = lambda motion: motion

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters (r,)."""
        return tuple(self.regression.columns[c] for c in self.columns)

    def rows(self, motion: Trajectory) -> Array:
        """Y (N, rows, r)."""
        rows, columns = list(self.places), list(self.columns)
        blocks = self.regression.blocks(self.seen(motion))
        return np.concatenate([block.dense()[:, rows][:, :, columns] for block in blocks])

    def gradient(self, motion: Trajectory, G: Array) -> Slopes:
        """Slopes of sum(G * Y) by q, v, a (N, nv); G (N, rows, r)."""
        size = len(motion), len(self.regression.rows), len(self.regression.columns)
        whole = np.zeros(size)
        rows, columns = np.ix_(self.places, self.columns)
        whole[:, rows, columns] = G
        q, v, a = pull_back(self.regression, self.seen(motion), whole)
        nv = motion.v.shape[1]  # sensors come after all joints
        return q[:, :nv], v[:, :nv], a[:, :nv]

    def subset_of_rows(self, names: tuple[str, ...]) -> "InformationModel":
        """The same about some of the parameters."""
        return replace(self, columns=tuple(self.regression.columns.index(name) for name in names))

    @cached_property
    def smooth(self) -> "InformationModel":
        """The same with a smooth sign(v): what a search can follow."""
        return replace(self, regression=smoothed(self.regression))


@dataclass(frozen=True, eq=False)
class TorqueModel:
    """Torques of the joints that move by the numbers at hand: `theta` of `regression`, and `links`
    (n_links, 10)."""

    regression: AnyRegression
    theta: Array
    links: Array
    tree: Tree
    coupling: Coupling | None = None

    def of(self, motion: Trajectory) -> Array:
        """tau (N, n)."""
        tau = newton_euler(self.tree, self.links, motion)
        if self.coupling is not None:
            tau = self.coupling.reduced(motion.q, tau)
        return tau + self.regression.torque(motion, self.theta)

    def gradient(self, motion: Trajectory, U: Array) -> Slopes:
        """Slopes of sum(U * tau) by q, v, a (N, nv); U (N, n)."""
        parts = [pull_back_torque(self.tree, self.coupling, self.links, motion, U)]
        if self.theta.any():
            parts.append(pull_back(self.regression, motion, U[:, :, None] * self.theta))
        q, v, a = (sum(part) for part in zip(*parts, strict=True))
        return q, v, a


def information_model(
    robot: RobotModel,
    base_names: tuple[str, ...],
    rows: tuple[str, ...] | None = None,
    cuts: tuple[SensorCut, ...] = (),
) -> InformationModel:
    """The question after the parameters named; `rows`: what is measured (None: the torques of all
    joints that move, and all that the sensors `cuts` do)."""
    instruments = instruments_of(robot, cuts)
    measured = instruments.measured if rows is None else rows
    places = tuple(instruments.measured.index(row) for row in measured)
    columns = torque_regression(robot, base_names, instruments)
    return InformationModel(columns, places, tuple(range(len(base_names))), instruments.motion)


def torque_model(robot: RobotModel) -> TorqueModel:
    """Torques by the numbers of the robot's own file, with what is mounted on it."""
    between = np.argwhere(robot.joint_terms.viscous_coupling)
    terms = (*SUFFIX, *(f"{robot.rows[i]}.fv.{robot.rows[j]}" for i, j in between))
    columns = torque_regression(robot, robot.term_columns(terms))
    links = robot.tree.composite_links(robot.phi)
    return TorqueModel(columns, robot.term_values(terms), links, robot.tree, robot.coupling)
