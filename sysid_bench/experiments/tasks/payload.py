"""The task `payload`: the ten parameters of the load."""

from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks._sensor_rows import with_sensors
from sysid_bench.experiments.tasks.task import (
    SensorOffset,
    Task,
    TaskDefinition,
    joint_torque_task,
    phi_without,
)
from sysid_bench.models.robot import RobotModel


@dataclass(frozen=True)
class PayloadTask(TaskDefinition):
    """The payload from joint torques, with the robot given.

    With sensors, their wrenches are rows besides all joint torques.
    """

    name: ClassVar[str] = "payload"
    identifies_payload: ClassVar[bool] = True
    writes_model: ClassVar[bool] = False
    supports_runs_without_payload: ClassVar[bool] = True
    supports_recordings: ClassVar[bool] = True

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task; joint terms are given."""
        if robot.payload_body is None:
            raise UnsupportedError(
                "No payload is mounted: the task 'payload' has nothing to identify."
            )
        bodies, phi = (robot.bodies[robot.payload_body],), robot.phi[[robot.payload_body]]
        given = phi_without(robot, bodies)
        task = joint_torque_task(self, robot, bodies, phi, given)
        return with_sensors(robot, task, sensor, given)
