"""The task `wrench`: all bodies distal to a force/torque sensor."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.experiments.tasks._sensor_rows import sensor_subtree, sensor_task
from sysid_bench.experiments.tasks.task import SensorOffset, Task, TaskDefinition, phi_with_payload
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import default_sensor


@dataclass(frozen=True)
class WrenchTask(TaskDefinition):
    """All bodies distal to a force/torque sensor from its wrench alone (Traversaro et al. 2015)."""

    name: ClassVar[str] = "wrench"
    accepts_terms: ClassVar[bool] = True
    default_estimator: ClassVar[str] = "wls"
    identifies_sub_tree: ClassVar[bool] = True
    measures_sensor_only: ClassVar[bool] = True
    supports_recordings: ClassVar[bool] = True

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task; a payload is a part of the body that carries it."""
        cuts = sensor_subtree(robot, default_sensor(robot, sensor))
        bodies = [b for b in cuts[0].bodies if b != robot.payload_body]
        # No other body is given: those before the sensor do not load it.
        phi, given = phi_with_payload(robot)[bodies], np.zeros_like(robot.phi)
        return sensor_task(self, robot, cuts, bodies, phi, given, terms=terms, offset=offset)
