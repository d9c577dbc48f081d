"""The task `terminal`: the last link from the torque of the last joint alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks.link import tool_link
from sysid_bench.experiments.tasks.task import SensorOffset, Task, TaskDefinition, joint_torque_task
from sysid_bench.models.robot import RobotModel


@dataclass(frozen=True)
class TerminalTask(TaskDefinition):
    """The composite last link, and the terms of the last joint, from that joint's torque alone."""

    name: ClassVar[str] = "terminal"
    accepts_terms: ClassVar[bool] = True
    default_estimator: ClassVar[str] = "min-norm"
    lumps_welded_bodies: ClassVar[bool] = True

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        """Pose the task; terms of other joints are given."""
        body, phi, given = tool_link(robot)
        dofs = _last_measured(robot)
        rows = tuple(robot.rows[dof] for dof in dofs)
        columns = tuple(c for c in robot.term_columns(terms) if robot.resolve_term(c)[1] in dofs)
        return joint_torque_task(self, robot, (body,), phi, given, terms=columns, rows=rows)


def _last_measured(robot: RobotModel) -> Sequence[int]:
    """Return the degrees of freedom of the last joint of the tool's branch that can move. A joint
    that follows others by a coupling has no torque of its own: the last joint that it follows
    stands for it."""
    moving, link_index = set(robot.torque_dofs.tolist()), int(robot.tree.carrier[robot.tool_body])
    # From the tool towards the base: fixed joints are skipped, blocked and following ones seen.
    while link_index >= 0:
        link = robot.tree.links[link_index]
        for joint in reversed(link.joints):
            if moving.issuperset(joint.dofs):
                return joint.dofs
            assert robot.coupling is not None
            drivers = robot.coupling.independent_of(joint.vadr)
            if len(drivers):
                return [int(drivers[-1])]
        link_index = link.parent
    raise UnsupportedError(
        f"No joint before the tool {robot.body_names[robot.tool_body]!r} can move; name another "
        "tool in the manifest."
    )
