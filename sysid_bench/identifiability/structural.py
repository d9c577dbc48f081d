"""The base parameters of a robot's task, asked with random states."""

import numpy as np

from sysid_bench.identifiability.base import base_map
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.states import random_states
from sysid_bench.regressors.coupled import torque_regression
from sysid_bench.regressors.fold import triangle
from sysid_bench.types import Array, BaseMap

SEED = 0
"""The same random states for everybody: a rank is a property of the robot, not of a draw."""


def structural_base(
    robot: RobotModel, parameters: tuple[str, ...], rows: tuple[str, ...] | None = None
) -> BaseMap:
    """The base map of the named parameters over all motions of the robot; `rows`: what is measured
    (None: `robot.torque_rows`). `robot.uncoupled` has the base of the whole tree."""
    return base_map(structural_factor(robot, parameters, rows), parameters)


def structural_factor(
    robot: RobotModel, parameters: tuple[str, ...], rows: tuple[str, ...] | None = None
) -> Array:
    """R (m, p) of the regressor over random states, whose column space is that of all motions."""
    columns = torque_regression(robot, parameters)
    own = robot.torque_rows
    measured = [own.index(row) for row in (own if rows is None else rows)]
    count = 64 + 3 * len(parameters) // len(measured)
    motion = random_states(robot, count, np.random.default_rng(SEED))
    factors = []
    for block in columns.blocks(motion):
        factors.append(triangle([block.dense()[:, measured].reshape(-1, len(parameters))]))
    return triangle(factors)
