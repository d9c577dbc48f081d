"""The task `wrench-payload`: the load distal to a force/torque sensor."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks._sensor_rows import sensor_subtree, sensor_task
from sysid_bench.experiments.tasks.task import SensorOffset, Task, TaskDefinition
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import default_sensor


@dataclass(frozen=True)
class WrenchPayloadTask(TaskDefinition):
    """The payload from the wrench of a force/torque sensor alone, with the bodies between given."""

    name: ClassVar[str] = "wrench-payload"
    accepts_terms: ClassVar[bool] = True
    default_estimator: ClassVar[str] = "wls"
    identifies_payload: ClassVar[bool] = True
    measures_sensor_only: ClassVar[bool] = True
    writes_model: ClassVar[bool] = False

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task. Raises UnsupportedError where no payload is distal to the sensor."""
        name = default_sensor(robot, sensor)
        cuts, payload = sensor_subtree(robot, name), robot.payload_body
        if payload is None or payload not in cuts[0].bodies:
            raise UnsupportedError(
                f"No payload is mounted behind the sensor {name!r}: the task 'wrench-payload' "
                "has nothing to identify."
            )
        # Bodies before the sensor do not load it.
        between = [b for b in cuts[0].bodies if b != payload]
        given = np.zeros_like(robot.phi)
        given[between] = robot.phi[between]
        phi = robot.phi[[payload]]
        return sensor_task(self, robot, cuts, [payload], phi, given, terms=terms, offset=offset)
