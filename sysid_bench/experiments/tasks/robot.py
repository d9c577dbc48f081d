"""The task `robot`: all links and joint terms."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.experiments.tasks._sensor_rows import with_sensors
from sysid_bench.experiments.tasks.task import (
    SensorOffset,
    Task,
    TaskDefinition,
    joint_torque_task,
    phi_with_payload,
    unknown_bodies,
)
from sysid_bench.models.robot import RobotModel


@dataclass(frozen=True)
class RobotTask(TaskDefinition):
    """All bodies and joint terms from joint torques, the payload as a part of the tool's body.

    With sensors, their wrenches are rows besides all joint torques.
    """

    name: ClassVar[str] = "robot"
    accepts_terms: ClassVar[bool] = True
    identifies_whole_robot: ClassVar[bool] = True
    supports_recordings: ClassVar[bool] = True

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task; the bodies that the manifest calls massless are given."""
        bodies, phi = unknown_bodies(robot), phi_with_payload(robot)
        indices = [robot.body_names.index(body.name) for body in bodies]
        given = phi.copy()
        given[indices] = 0.0
        if robot.payload_body is not None:
            given[robot.payload_body] = 0.0  # already a part of the tool's body
        task = joint_torque_task(self, robot, bodies, phi[indices], given, terms)
        return with_sensors(robot, task, sensor, given)
