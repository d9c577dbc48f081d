"""Conformance kit of tasks: the unknowns and the given parameters make the whole robot.

Torques are linear in the composite parameters of links and in joint terms, so that equal sums of
parameters mean equal torques for every motion.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import Finding, Kit, Laws, robot_of_kit
from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.experiments.tasks.task import Task, TaskDefinition, columns_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import instruments_of
from sysid_bench.types import Array

TOLERANCE: Final = 1e-9
"""Relative to the largest parameter of its kind (mass, first moment, moment of inertia)."""

TERMS: Final = ("viscous", "coulomb")
"""Joint terms that are unknown besides, for tasks that accept terms."""

POSED: Final = "poses its unknowns"


@dataclass(frozen=True, eq=False)
class TaskProblem:
    """A robot to pose the task for, and what else is asked of it."""

    name: str
    robot: RobotModel
    terms: tuple[str, ...] = ()
    sensor: str | None = None


@cache
def task_cases() -> tuple[TaskProblem, ...]:
    """An arm and a random tree with a payload, an arm without one, and a humanoid with sensors."""
    robots = [
        ("ur5 with a payload", "ur5", "box-2kg", None),
        ("ur5", "ur5", "none", None),
        ("random:7 with a payload", "random:7", "box-2kg", None),
        ("icub with a payload and a sensor", "icub", "box-2kg", "l_arm_ft_sensor"),
    ]
    return tuple(
        TaskProblem(name, robot_of_kit(robot, payload), sensor=sensor)
        for name, robot, payload, sensor in robots
    )


def check_task(
    definition: TaskDefinition, cases: Sequence[TaskProblem] | None = None
) -> list[Finding]:
    """Findings of all laws on all cases (None: `task_cases`, with joint terms besides where the
    task accepts them). A case that the task refuses with UnsupportedError does not count."""
    if not isinstance(definition, TaskDefinition):
        base = f"{TaskDefinition.__module__}.{TaskDefinition.__name__}"
        message = f"{type(definition).__name__} is not derived from {base}"
        return [Finding("is a task", "its class", False, message)]
    if cases is None:
        cases = task_cases()
        if definition.accepts_terms and not definition.measures_sensor_only:
            with_terms = (
                TaskProblem(f"{case.name}, {', '.join(TERMS)}", case.robot, TERMS, case.sensor)
                for case in cases
            )
            cases = [case for pair in zip(cases, with_terms, strict=True) for case in pair]
    refused = Finding(POSED, "all robots", False, "it refused every robot with UnsupportedError")
    return _TASK_KIT.findings(definition, cases) or [refused]


def _posed(definition: TaskDefinition, case: TaskProblem) -> Task | None:
    """The task for a robot, None where it is refused."""
    try:
        return definition.unknowns(case.robot, case.terms, case.sensor, None)
    except UnsupportedError:
        return None


def _names_unknowns_once(definition: TaskDefinition, case: TaskProblem, task: Task) -> str | None:
    """Unique names, the ten of each unknown body among them."""
    names = list(task.parameters)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        return f"unknowns are named twice: {', '.join(twice)}"
    absent = sorted(_inertial(task) - set(names))
    return f"parameters of unknown bodies are missing: {', '.join(absent)}" if absent else None


def _names_parameters_of_the_robot(
    definition: TaskDefinition, case: TaskProblem, task: Task
) -> str | None:
    """Unknowns are inertial or terms of joints; a sensor has constants of its own instead."""
    if task.definition.measures_sensor_only:
        return None
    strange = [name for name, _ in _unknown_terms(task) if not _is_term(name, case.robot)]
    if not strange:
        return None
    return f"the unknown {strange[0]!r} is neither a parameter of a body nor a joint term"


def _is_term(name: str, robot: RobotModel) -> bool:
    try:
        robot.resolve_term(name)
    except UsageError:
        return False
    return True


def _has_finite_true_values(
    definition: TaskDefinition, case: TaskProblem, task: Task
) -> str | None:
    return None if np.isfinite(task.truth.theta).all() else "true values are not finite"


def _adds_up_to_the_links(definition: TaskDefinition, case: TaskProblem, task: Task) -> str | None:
    """Composite link parameters, unknown plus given; behind a sensor, those of its sub-tree."""
    robot = case.robot
    tree = instruments_of(robot, task.cuts).tree
    expected = tree.link_parameters(robot.phi)
    error = np.abs(task.known_links + tree.link_parameters(_unknown_phi(task, robot)) - expected)
    # Largest mass, first moment and moment of inertia, (10,).
    kinds = (slice(0, 1), slice(1, 4), slice(4, 10))
    # Tiny floors (kg, kg m, kg m^2): a robot without first moments would allow no rounding.
    largest = [max(float(np.abs(expected[:, kind]).max(initial=0.0)), 1e-6) for kind in kinds]
    apart = np.flatnonzero((error > TOLERANCE * np.repeat(largest, (1, 3, 6))).any(axis=1))
    # Bodies that do not move have the carrier -1, which is not an index of `apart`.
    links = {int(tree.carrier[b]) for b in _measured_bodies(task, robot)}
    wrong = sorted(robot.body_names[tree.links[k].body] for k in links.intersection(apart.tolist()))
    if not wrong:
        return None
    return f"unknown and given parameters of {', '.join(wrong)} do not add up to those of the robot"


def _adds_up_to_the_joint_terms(
    definition: TaskDefinition, case: TaskProblem, task: Task
) -> str | None:
    """Joint terms, unknown plus given; a sensor behind the joints does not measure them."""
    if task.definition.measures_sensor_only:
        return None
    robot, total = case.robot, _total_terms(task, case.robot)
    wrong = [t for t in SUFFIX if not np.allclose(total[t], getattr(robot.joint_terms, t))]
    if not wrong:
        return None
    return f"unknown and given joint terms differ from the robot's: {', '.join(wrong)}"


NAMING_LAWS: Final[Laws] = {
    "names each unknown once": _names_unknowns_once,
    "names parameters of the robot": _names_parameters_of_the_robot,
}
SUM_LAWS: Final[Laws] = {
    "has finite true values": _has_finite_true_values,
    "adds up to the links of the robot": _adds_up_to_the_links,
    "adds up to the joint terms of the robot": _adds_up_to_the_joint_terms,
}


def _inertial(task: Task) -> set[str]:
    """Names of the inertial parameters of the unknown bodies."""
    return set(columns_of(task.bodies))


def _unknown_phi(task: Task, robot: RobotModel) -> Array:
    """phi (nb, 10) of the unknown bodies, zero for the others."""
    truth = dict(zip(task.parameters, task.truth.theta, strict=True))
    phi = np.zeros_like(robot.phi)
    for body in task.bodies:
        phi[robot.body_names.index(body.name)] = [truth[column] for column in body.columns]
    return phi


def _unknown_terms(task: Task) -> Iterator[tuple[str, Any]]:
    """(name, true value) of the unknowns that are not inertial."""
    inertial = _inertial(task)
    for name, value in zip(task.parameters, task.truth.theta, strict=True):
        if name not in inertial:
            yield name, value


def _total_terms(task: Task, robot: RobotModel) -> dict[str, Array]:
    """Unknown plus given joint terms, (nv,) each."""
    total = {term: task.known_terms[term].copy() for term in SUFFIX}
    for name, value in _unknown_terms(task):
        term, dof, other = robot.resolve_term(name)
        # Friction between two joints is not a term of one of them.
        total[term][dof] += value if other is None else 0.0
    return total


def _measured_bodies(task: Task, robot: RobotModel) -> Iterable[int]:
    """Indices of the bodies whose parameters the measured rows depend on."""
    if task.definition.measures_sensor_only:
        return task.cuts[0].bodies
    return range(len(robot.body_names))


_TASK_KIT: Final = Kit(
    runs=POSED,
    run=_posed,
    # Sums of parameters are found by name.
    laws=lambda case, task: () if task is None else (NAMING_LAWS, SUM_LAWS),
    given=lambda case: (case.robot.phi, case.robot.joint_terms),
    changed="it changed the robot",
)
