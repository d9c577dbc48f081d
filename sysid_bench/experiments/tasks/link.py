"""The task `link`: the last link with all that is welded to it."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks.task import SensorOffset, Task, TaskDefinition, joint_torque_task
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, Body


@dataclass(frozen=True)
class LinkTask(TaskDefinition):
    """The composite link that carries the tool, and joint terms that are unknown besides, from
    joint torques; all else is given."""

    name: ClassVar[str] = "link"
    accepts_terms: ClassVar[bool] = True
    lumps_welded_bodies: ClassVar[bool] = True

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task; `terms`, by default none, are unknown on all joints that they name."""
        body, phi, given = tool_link(robot)
        return joint_torque_task(self, robot, (body,), phi, given, terms=terms)


def tool_link(robot: RobotModel) -> tuple[Body, Array, Array]:
    """Return the body of the link that carries the tool, its composite phi (10,) in the frame of
    that body, and phi (nb, 10) of the bodies of other links."""
    link = int(robot.tree.carrier[robot.tool_body])
    if link < 0:
        raise UnsupportedError(f"The tool {robot.body_names[robot.tool_body]!r} does not move.")
    phi = robot.tree.link_parameters(robot.phi)[link]
    given = robot.phi.copy()
    # What is welded to the tool is a part of its composite, and would count twice.
    given[np.asarray(robot.tree.carrier) == link] = 0.0
    return robot.bodies[robot.tree.links[link].body], phi, given
