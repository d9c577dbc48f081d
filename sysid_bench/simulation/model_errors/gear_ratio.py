"""Gear ratio errors: joints that move by another amount than their drives report."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import Size, joint_size


@dataclass(frozen=True)
class GearRatio:
    """Relative error `error` of the gear ratio of each independent hinge and slide.

    A joint moves by (1 + error) of what the model computes from the drive, and the model computes
    (1 + error) of its torque, since both have the same power. Gear ratios are exact; ratios of
    data sheets, belts and lead screws err by 0.1 to 1 % (to be verified).
    """

    error: Size = field(default=0.005, metadata={"unit": "%"})
    sizes: ClassVar[tuple[str, ...]] = ("error",)

    def __post_init__(self) -> None:
        """Raise UsageError for errors that stop or reverse a joint."""
        if not (np.abs(np.asarray(self.error, dtype=float)) < 0.5).all():
            raise UsageError(
                f"error = {self.error!r} of the model error 'gear-ratio': give less than 50 %."
            )

    @staticmethod
    def size_names(robot: RobotModel) -> tuple[str, ...]:
        """Return the names of the joints that a list of errors is for."""
        return robot.torque_rows

    def apply(self, robot: RobotModel, rng: np.random.Generator) -> RobotModel:
        """Return the robot with these ratios; nothing is drawn."""
        error = joint_size(self.error, self.size_names(robot), "error")
        if not error.any():
            return robot
        ratio = np.ones(robot.nv) if robot.drive_ratio is None else robot.drive_ratio.copy()
        scalar = np.isin(robot.torque_dofs, robot.scalar_dofs)
        ratio[robot.torque_dofs[scalar]] *= 1.0 + error[scalar]
        return replace(robot, drive_ratio=ratio)
