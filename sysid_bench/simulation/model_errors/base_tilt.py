"""Base tilt: gravity that is not where the model takes it to be."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.offset_robot import with_gravity
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.random_direction import random_direction
from sysid_bench.simulation.size import check_size
from sysid_bench.spatial import matrix_of_quaternion, quaternion_of_rotation
from sysid_bench.types import Array


@dataclass(frozen=True)
class BaseTilt:
    """Rotation of gravity by `angle` about a random axis across it: a base that is not level.

    Bases mounted by hand are off by 0.1 to 0.5 deg (to be verified); 0.3 deg turn 0.5 % of gravity
    sideways.
    """

    angle: float = field(default=0.00524, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("angle",)

    def __post_init__(self) -> None:
        """Raise UsageError for a negative angle."""
        check_size("angle of the model error 'base-tilt'", self.angle)

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot under tilted gravity."""
        gravity = np.array(robot.mj.opt.gravity)
        along = random_direction(1, rng, dimension=2)[0]
        if self.angle == 0.0 or not gravity.any():
            return robot
        axis = along @ _across(gravity)
        R = matrix_of_quaternion(quaternion_of_rotation(self.angle * axis))
        return with_gravity(robot, R @ gravity)


def _across(gravity: Array) -> Array:
    """Two unit vectors (2, 3) at right angles to gravity and to each other."""
    down = gravity / np.linalg.norm(gravity)
    first = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(down, first)])
