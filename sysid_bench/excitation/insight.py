"""What a designer may ask about a robot: the rows of a task's regressor, and torques."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.regressors.adjoint import Slopes, pull_back, pull_back_torque, smoothed
from sysid_bench.regressors.kernel import newton_euler
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class Question:
    """The base regressor of a task: the chosen `columns` of `regression` at the measured rows
    `places`."""

    regression: Regression
    places: tuple[int, ...]
    columns: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters (r,)."""
        return tuple(self.regression.columns[c] for c in self.columns)

    def rows(self, motion: Trajectory) -> Array:
        """Y (N, rows, r)."""
        rows, columns = list(self.places), list(self.columns)
        return np.concatenate(
            [block.dense()[:, rows][:, :, columns] for block in self.regression.blocks(motion)]
        )

    def slopes(self, motion: Trajectory, G: Array) -> Slopes:
        """Slopes of sum(G * Y) by q, v, a (N, nv); G (N, rows, r)."""
        size = len(motion), len(self.regression.rows), len(self.regression.columns)
        whole = np.zeros(size)
        rows, columns = np.ix_(self.places, self.columns)
        whole[:, rows, columns] = G
        return pull_back(self.regression, motion, whole)

    def only(self, names: tuple[str, ...]) -> "Question":
        """The same about some of the parameters."""
        return replace(self, columns=tuple(self.regression.columns.index(name) for name in names))

    @cached_property
    def smooth(self) -> "Question":
        """The same with a smooth sign(v): what a search can follow."""
        return replace(self, regression=smoothed(self.regression))


@dataclass(frozen=True, eq=False)
class Torque:
    """Joint torques by the numbers at hand: `theta` of `regression`, and `links` (n_links, 10)."""

    regression: Regression
    theta: Array
    links: Array

    def of(self, motion: Trajectory) -> Array:
        """tau (N, nv)."""
        tau = newton_euler(self.regression.tree, self.links, motion)
        return tau + self.regression.torque(motion, self.theta)

    def slopes(self, motion: Trajectory, U: Array) -> Slopes:
        """Slopes of sum(U * tau) by q, v, a (N, nv); U (N, nv)."""
        parts = [pull_back_torque(self.regression.tree, self.links, motion, U)]
        if self.theta.any():
            parts.append(pull_back(self.regression, motion, U[:, :, None] * self.theta))
        q, v, a = (sum(part) for part in zip(*parts, strict=True))
        return q, v, a


def question(
    robot: RobotModel, base_names: tuple[str, ...], rows: tuple[str, ...] | None = None
) -> Question:
    """The question after the parameters named; `rows`: whose torque is measured (None: all)."""
    measured = robot.rows if rows is None else rows
    places = tuple(robot.rows.index(row) for row in measured)
    return Question(regression(robot, base_names), places, tuple(range(len(base_names))))


def torque_of(robot: RobotModel) -> Torque:
    """Torques by the numbers of the robot's own file, with what is mounted on it."""
    terms = tuple(SUFFIX)
    columns = regression(robot, robot.term_columns(terms))
    return Torque(columns, robot.term_values(terms), robot.tree.lumped(robot.phi))
