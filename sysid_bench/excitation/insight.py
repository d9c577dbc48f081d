"""What a designer may ask about a robot: the rows of a task's regressor, and torques."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.regressors.adjoint import Slopes, pull_back, pull_back_torque, smoothed
from sysid_bench.regressors.kernel import newton_euler
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class Question:
    """The base regressor of a task: the columns of `regression` at the measured rows `places`."""

    regression: Regression
    places: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters (r,)."""
        return self.regression.columns

    def rows(self, motion: Trajectory) -> Array:
        """Y (N, rows, r)."""
        blocks = [block.dense()[:, list(self.places)] for block in self.regression.blocks(motion)]
        return np.concatenate(blocks)

    def slopes(self, motion: Trajectory, G: Array) -> Slopes:
        """Slopes of sum(G * Y) by q, v, a (N, nv); G (N, rows, r)."""
        whole = np.zeros((len(motion), len(self.regression.rows), G.shape[2]))
        whole[:, list(self.places)] = G
        return pull_back(self.regression, motion, whole)

    @cached_property
    def smooth(self) -> "Question":
        """The same with a smooth sign(v): what a search can follow."""
        return Question(smoothed(self.regression), self.places)


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
    return Question(regression(robot, base_names), tuple(robot.rows.index(row) for row in measured))


def torque_of(robot: RobotModel) -> Torque:
    """Torques by the numbers of the robot's own file, with what is mounted on it."""
    terms = tuple(SUFFIX)
    columns = regression(robot, robot.term_columns(terms))
    return Torque(columns, robot.term_values(terms), robot.tree.lumped(robot.phi))
