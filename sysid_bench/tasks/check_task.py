"""Check of a task of the package or of a plug-in author: its parts make the whole robot."""

from collections.abc import Iterator

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import instruments_of
from sysid_bench.tasks.task import Task, TaskDefinition
from sysid_bench.types import Array

TOLERANCE = 1e-9
"""Relative to the largest parameter of its kind (mass, first moment, moment of inertia)."""


def check_task(
    definition: TaskDefinition,
    robot: RobotModel,
    terms: tuple[str, ...] = (),
    sensor: str | None = None,
) -> tuple[str, ...]:
    """Return what is wrong with a task on a robot, one sentence each; nothing where it is sound.

    Unknowns are unique and finite, and with the given parameters they add up to the robot's:
    torques are linear in the composite parameters of links and in joint terms, so that equal sums
    mean equal torques for every motion. Raises UnsupportedError where the task does not apply.
    """
    task = definition.unknowns(robot, terms, sensor, None)
    names = list(task.parameters)
    twice = sorted({name for name in names if names.count(name) > 1})
    absent = [c for body in task.bodies for c in body.columns if c not in names]
    if twice:
        return (f"Unknowns are named twice: {', '.join(twice)}.",)
    if absent:
        return (f"Parameters of unknown bodies are missing: {', '.join(absent)}.",)
    if not np.isfinite(task.truth.theta).all():
        return ("True values are not finite.",)
    return (*_wrong_links(task, robot), *_wrong_terms(task, robot))


def _wrong_links(task: Task, robot: RobotModel) -> Iterator[str]:
    """Compare composite link parameters; behind a sensor, those of its sub-tree alone."""
    truth = dict(zip(task.parameters, task.truth.theta, strict=True))
    phi = np.zeros_like(robot.phi)
    for body in task.bodies:
        phi[robot.body_names.index(body.name)] = [truth[column] for column in body.columns]
    tree = instruments_of(robot, task.cuts).tree
    expected = tree.link_parameters(robot.phi)
    error = np.abs(task.known_links + tree.link_parameters(phi) - expected)
    bound = TOLERANCE * _scale(expected)
    sensed = task.definition.measures_sensor_only
    bodies = task.cuts[0].bodies if sensed else range(len(robot.body_names))
    links = {int(tree.carrier[b]) for b in bodies} - {-1}
    wrong = [robot.body_names[tree.links[k].body] for k in links if (error[k] > bound).any()]
    if wrong:
        yield (
            f"Unknown and given parameters of {', '.join(sorted(wrong))} do not add up to those "
            "of the robot."
        )


def _scale(expected: Array) -> Array:
    """Largest mass, first moment and moment of inertia, (10,)."""
    kinds = (slice(0, 1), slice(1, 4), slice(4, 10))
    largest = [max(float(np.abs(expected[:, kind]).max(initial=0.0)), 1e-6) for kind in kinds]
    return np.repeat(largest, (1, 3, 6))


def _wrong_terms(task: Task, robot: RobotModel) -> Iterator[str]:
    """Compare joint terms, which a sensor behind the joints does not measure."""
    if task.definition.measures_sensor_only:
        return
    inertial = {column for body in task.bodies for column in body.columns}
    total = {term: task.known_terms[term].copy() for term in SUFFIX}
    for name, value in zip(task.parameters, task.truth.theta, strict=True):
        if name in inertial:
            continue
        try:
            term, dof, other = robot.resolve_term(name)
        except UsageError:
            yield f"The unknown {name!r} is neither a parameter of a body nor a joint term."
            continue
        if other is None:
            total[term][dof] += value
    wrong = [t for t in SUFFIX if not np.allclose(total[t], getattr(robot.joint_terms, t))]
    if wrong:
        yield f"Unknown and given joint terms differ from the robot's: {', '.join(wrong)}."
