"""The base parameters of a robot's task, asked with random states."""

import numpy as np

from sysid_bench.identifiability.base import base_map
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.states import random_states
from sysid_bench.regressors.fold import triangle
from sysid_bench.regressors.regression import regression
from sysid_bench.types import BaseMap

SEED = 0
"""The same random states for everybody: a rank is a property of the robot, not of a draw."""


def structural_base(robot: RobotModel, parameters: tuple[str, ...]) -> BaseMap:
    """The base map of the named parameters over all motions of the robot."""
    columns = regression(robot, parameters)
    count = 64 + 3 * len(parameters) // robot.nv
    motion = random_states(robot, count, np.random.default_rng(SEED))
    factors = []
    for block in columns.blocks(motion):
        factors.append(triangle([block.dense().reshape(-1, len(parameters))]))
    return base_map(triangle(factors), parameters)
