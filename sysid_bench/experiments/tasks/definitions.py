"""Tasks of the package, from joint torques and from the wrenches of force/torque sensors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks.task import (
    SensorOffset,
    Task,
    TaskDefinition,
    Terms,
    columns_of,
    joint_torque_task,
    phi_with_payload,
    phi_without,
    unknown_bodies,
)
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import (
    SensorSubtree,
    check_chain,
    default_sensor,
    instruments_of,
    sensor_names,
    subtree_at,
)
from sysid_bench.types import Array, Body, Truth


def with_sensors(robot: RobotModel, task: Task, sensor: str | None, given: Array) -> Task:
    """Return the task with the wrenches of sensors as rows after all joint torques; `given`
    (nb, 10): parameters of the bodies that are not unknown."""
    if sensor is None:
        return task
    cuts = tuple(subtree_at(robot, name, ()) for name in sensor_names(sensor))
    for cut in cuts:
        check_chain(robot, cut)
    rows = robot.torque_rows + tuple(row for cut in cuts for row in cut.rows)
    # A sensor divides a link in two: composites are those of the divided tree.
    known_links = instruments_of(robot, cuts).tree.link_parameters(given)
    return replace(task, rows=rows, cuts=cuts, known_links=known_links)


def sensor_subtree(robot: RobotModel, sensor: str) -> tuple[SensorSubtree, ...]:
    """Return the cut at a sensor, followed by those of the sensors that end its sub-tree."""
    cut = subtree_at(robot, sensor)
    check_chain(robot, cut)
    # The sensor measures the wrench of all that is distal; that of the others is subtracted.
    return (cut, *(subtree_at(robot, name) for name in cut.end_sensors))


def sensor_task(
    definition: TaskDefinition,
    robot: RobotModel,
    cuts: tuple[SensorSubtree, ...],
    bodies: Sequence[int],
    phi: Array,
    given: Array,
    terms: Terms,
    offset: SensorOffset | None,
) -> Task:
    """Build a task on the wrench of one sensor: the `bodies` (indices) with true parameters `phi`
    (n, 10) are unknown, `given` (nb, 10) holds the others. With the term "offset" the constants of
    the sensors are unknown besides."""
    # Friction acts in the joint: the wrench of what is distal to it does not depend on it.
    if terms not in ((), ("offset",)):
        raise UnsupportedError(
            f"A force/torque sensor does not measure joint terms: {', '.join(terms)} cannot be "
            f"identified with the task {definition.name!r}. Only 'offset' can: the constants of "
            "the sensor."
        )
    unknown = tuple(robot.bodies[b] for b in bodies)
    parameters, theta = columns_of(unknown), phi.ravel()
    if terms:
        names = tuple(f"{row}.{SUFFIX['offset']}" for cut in cuts for row in cut.rows)
        constants = np.zeros(6 * len(cuts)) if offset is None else offset(len(cuts))
        parameters, theta = parameters + names, np.concatenate([theta, constants])
    known_links = instruments_of(robot, cuts).tree.link_parameters(given)
    return Task(
        definition, unknown, Truth(parameters, theta), known_links, {}, rows=cuts[0].rows, cuts=cuts
    )


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
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
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
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
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


@dataclass(frozen=True)
class LinkTask(TaskDefinition):
    """The composite link that carries the tool, and joint terms that are unknown besides, from
    joint torques; all else is given."""

    name: ClassVar[str] = "link"
    accepts_terms: ClassVar[bool] = True
    lumps_welded_bodies: ClassVar[bool] = True

    def unknowns(
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
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


@dataclass(frozen=True)
class TerminalTask(TaskDefinition):
    """The composite last link, and the terms of the last joint, from that joint's torque alone."""

    name: ClassVar[str] = "terminal"
    accepts_terms: ClassVar[bool] = True
    default_estimator: ClassVar[str] = "min-norm"
    lumps_welded_bodies: ClassVar[bool] = True

    def unknowns(
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
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
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
    ) -> Task:
        """Pose the task; a payload is a part of the body that carries it."""
        cuts = sensor_subtree(robot, default_sensor(robot, sensor))
        bodies = [b for b in cuts[0].bodies if b != robot.payload_body]
        # No other body is given: those before the sensor do not load it.
        phi, given = phi_with_payload(robot)[bodies], np.zeros_like(robot.phi)
        return sensor_task(self, robot, cuts, bodies, phi, given, terms=terms, offset=offset)


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
        self, robot: RobotModel, terms: Terms, sensor: str | None, offset: SensorOffset | None
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
