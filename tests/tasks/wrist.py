"""A task of a plug-in author: the last two bodies, with all before them given."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.experiments.tasks.task import (
    SensorOffset,
    Task,
    TaskDefinition,
    joint_torque_task,
    phi_without,
)
from sysid_bench.models.robot import RobotModel


@dataclass(frozen=True)
class Wrist(TaskDefinition):
    """The last two bodies and joint terms from joint torques, with the other bodies given."""

    accepts_terms: ClassVar[bool] = True

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        bodies = robot.bodies[-2:]
        given = phi_without(robot, bodies)
        return joint_torque_task(self, robot, bodies, robot.phi[-2:], given, terms)
