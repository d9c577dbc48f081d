"""Plant without unmodelled effects: the robot with its joint terms alone."""

from dataclasses import dataclass

from sysid_bench.models.robot import RobotModel


@dataclass(frozen=True)
class Matched:
    """No unmodelled effect: the identified model can represent the plant exactly."""

    def prepare(self, robot: RobotModel) -> None:
        """Return no force law."""
