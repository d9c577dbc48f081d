"""Kinematic errors: joint frames that are displaced and turned in their parent links."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.coupling.constraints import ChainClosure
from sysid_bench.models.offset_robot import with_body_offset
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.random_direction import random_direction
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Kinematics:
    """Displacement by `position` and rotation by `rotation` of every joint frame in its parent
    link, in random directions.

    The link parameters stay those of the model in the links' own frames, which move with their
    joints. Uncalibrated industrial arms have 0.5 to 2 mm and 0.05 to 0.2 deg per joint (Mooring,
    Roth and Driels 1991, ch. 1; to be verified for other robots). A free joint has no frame in a
    parent; links of a closed chain are displaced but not turned, since a planar loop with skew
    axes cannot move.
    """

    position: Size = field(default=0.001, metadata={"unit": "m"})
    rotation: Size = field(default=0.00175, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("position", "rotation")

    def __post_init__(self) -> None:
        """Raise UsageError for a negative size."""
        check_size("position of the model error 'kinematics'", self.position)
        check_size("rotation of the model error 'kinematics'", self.rotation)

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with displaced joint frames."""
        names = [joint.name for joint in robot.joints]
        position = joint_size(self.position, names, "position")
        rotation = joint_size(self.rotation, names, "rotation")
        shift, turn = random_direction(len(names), rng), random_direction(len(names), rng)
        chosen = {}
        for b, j, closed in _displaced_joints(robot):
            by = position[j] * shift[j], (0.0 if closed else rotation[j]) * turn[j]
            if any(part.any() for part in by):
                chosen[b] = by
        return with_body_offset(robot, chosen) if chosen else robot


def _displaced_joints(robot: RobotModel) -> list[tuple[int, int, bool]]:
    """(body, its first joint, True in a closed chain) of each link without a free joint."""
    loops = _loop_dofs(robot)
    chosen = []
    for b in range(len(robot.body_names)):
        j = int(robot.mj.body_jntadr[b + 1])
        if j >= 0 and robot.joints[j].kind != "free":
            chosen.append((b, j, bool(np.isin(robot.joints[j].vadr, loops))))
    return chosen


def _loop_dofs(robot: RobotModel) -> Array:
    """Degrees of freedom (k,) in closed chains."""
    groups = () if robot.coupling is None else robot.coupling.groups
    closed = [g.dofs for g in groups if any(isinstance(c, ChainClosure) for c in g.constraints)]
    return np.concatenate([np.zeros(0, dtype=int), *closed])
