"""Rows of force/torque sensors: besides joint torques, or alone."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks.task import SensorOffset, Task, TaskDefinition, columns_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import (
    SensorSubtree,
    check_chain,
    instruments_of,
    sensor_names,
    subtree_at,
)
from sysid_bench.types import Array, Truth


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
    terms: tuple[str, ...],
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
        names, constants = _sensor_constants(cuts, offset)
        parameters, theta = parameters + names, np.concatenate([theta, constants])
    known_links = instruments_of(robot, cuts).tree.link_parameters(given)
    return Task(
        definition, unknown, Truth(parameters, theta), known_links, {}, rows=cuts[0].rows, cuts=cuts
    )


def _sensor_constants(
    cuts: tuple[SensorSubtree, ...], offset: SensorOffset | None
) -> tuple[tuple[str, ...], Array]:
    """Names and true values of the constants of sensors, six each; zero without an offset."""
    names = tuple(f"{row}.{SUFFIX['offset']}" for cut in cuts for row in cut.rows)
    return names, np.zeros(6 * len(cuts)) if offset is None else offset(len(cuts))
