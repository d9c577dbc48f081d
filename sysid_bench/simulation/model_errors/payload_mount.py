"""Payload mounting errors: a payload that is displaced and turned on its flange."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.offset_robot import with_body_offset
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.random_direction import random_direction
from sysid_bench.simulation.size import check_size


@dataclass(frozen=True)
class PayloadMount:
    """Displacement by `position` and rotation by `rotation` of the payload at the tool frame, in
    random directions; none without a payload.

    The payload's parameters stay those of its own frame. Flanges with a centring collar and a pin
    leave about 0.1 mm, hand-clamped weights 1 mm and 0.5 deg (to be verified).
    """

    position: float = field(default=0.001, metadata={"unit": "m"})
    rotation: float = field(default=0.00873, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("position", "rotation")

    def __post_init__(self) -> None:
        """Raise UsageError for a negative size."""
        check_size("position of the model error 'payload-mount'", self.position)
        check_size("rotation of the model error 'payload-mount'", self.rotation)

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with the payload displaced."""
        shift, turn = random_direction(2, rng)
        if robot.payload_body is None or (self.position == 0.0 and self.rotation == 0.0):
            return robot
        by = self.position * shift, self.rotation * turn
        return with_body_offset(robot, {robot.payload_body: by})
