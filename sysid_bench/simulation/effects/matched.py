"""The plant that the identified model can express: the robot with its joint terms, nothing else."""

from dataclasses import dataclass

from sysid_bench.models.robot import RobotModel


@dataclass(frozen=True)
class Matched:
    """No effect."""

    def prepare(self, robot: RobotModel) -> None:
        """Nothing to add."""
