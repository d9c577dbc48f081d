"""Conformance kit of tasks: the unknowns and the given parameters make the whole robot.

Torques are linear in the composite parameters of links and in joint terms, so that equal sums of
parameters mean equal torques for every motion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import Finding, Kit, KitCase, Law, robot_of_kit
from sysid_bench.errors import UnsupportedError, UsageError
from sysid_bench.experiments.tasks.task import TaskDefinition, columns_of
from sysid_bench.models.robot import SUFFIX, RobotModel
from sysid_bench.models.sensor import instruments_of
from sysid_bench.types import Array

TOLERANCE: Final = 1e-9
"""Relative to the largest parameter of its kind (mass, first moment, moment of inertia)."""

TERMS: Final = ("viscous", "coulomb")
"""Joint terms that are unknown besides, for tasks that accept terms."""


@dataclass(frozen=True, eq=False)
class TaskProblem(KitCase):
    """A robot to pose the task for, and what else is asked of it."""

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
    message = "it refused every robot with UnsupportedError"
    refused = Finding(_TaskKit.runs, "all robots", False, message)
    # A task that refuses all would keep every law.
    return _TaskKit.check(definition, cases) or [refused]


class _TaskKit(Kit[TaskProblem]):
    """`result`: the task for a robot, None where it is refused."""

    runs = "poses its unknowns"
    changed = "it changed the robot"

    def run(self) -> Any:
        case = self.case
        try:
            return self.plugin.unknowns(case.robot, case.terms, case.sensor, None)
        except UnsupportedError:
            return None

    def kind(self) -> str:
        return "none" if self.result is None else ""

    def given(self) -> Any:
        return self.case.robot.phi, self.case.robot.joint_terms

    def _unknown_terms(self) -> Iterator[tuple[str, Any]]:
        """(name, true value) of the unknowns that are not inertial."""
        inertial = columns_of(self.result.bodies)
        for name, value in zip(self.result.parameters, self.result.truth.theta, strict=True):
            if name not in inertial:
                yield name, value

    @Law("names each unknown once", first=True)  # sums of parameters are found by name
    def unique(self) -> str | None:
        """Unique names, the ten of each unknown body among them."""
        names = list(self.result.parameters)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            return f"unknowns are named twice: {', '.join(twice)}"
        absent = ", ".join(sorted(set(columns_of(self.result.bodies)) - set(names)))
        return f"parameters of unknown bodies are missing: {absent}" if absent else None

    @Law("names parameters of the robot", first=True)
    def names(self) -> str | None:
        """Unknowns are inertial or terms of joints; a sensor has constants of its own instead."""
        if self.result.definition.measures_sensor_only:
            return None
        for name, _ in self._unknown_terms():
            try:
                self.case.robot.resolve_term(name)
            except UsageError:
                return f"the unknown {name!r} is neither a parameter of a body nor a joint term"
        return None

    @Law("has finite true values")
    def finite(self) -> str | None:
        finite = np.isfinite(self.result.truth.theta).all()
        return None if finite else "true values are not finite"

    @Law("adds up to the links of the robot")
    def links(self) -> str | None:
        """Composite link parameters, unknown plus given; behind a sensor, those of its sub-tree."""
        robot, task = self.case.robot, self.result
        tree = instruments_of(robot, task.cuts).tree
        expected = tree.link_parameters(robot.phi)
        error = np.abs(task.known_links + tree.link_parameters(self._unknown_phi()) - expected)
        # Largest mass, first moment and moment of inertia, (10,).
        kinds = (slice(0, 1), slice(1, 4), slice(4, 10))
        # Tiny floors (kg, kg m, kg m^2): a robot without first moments would allow no rounding.
        largest = [max(float(np.abs(expected[:, kind]).max(initial=0.0)), 1e-6) for kind in kinds]
        apart = np.flatnonzero((error > TOLERANCE * np.repeat(largest, (1, 3, 6))).any(axis=1))
        # Bodies whose parameters the measured rows depend on; those that do not move have the
        # carrier -1, which is not an index of `apart`.
        sensor_only = task.definition.measures_sensor_only
        bodies = task.cuts[0].bodies if sensor_only else range(len(robot.body_names))
        carriers = {int(tree.carrier[b]) for b in bodies}.intersection(apart.tolist())
        wrong = ", ".join(sorted(robot.body_names[tree.links[k].body] for k in carriers))
        if not wrong:
            return None
        return f"unknown and given parameters of {wrong} do not add up to those of the robot"

    def _unknown_phi(self) -> Array:
        """phi (nb, 10) of the unknown bodies, zero for the others."""
        task, robot = self.result, self.case.robot
        truth = dict(zip(task.parameters, task.truth.theta, strict=True))
        phi = np.zeros_like(robot.phi)
        for body in task.bodies:
            phi[robot.body_names.index(body.name)] = [truth[column] for column in body.columns]
        return phi

    @Law("adds up to the joint terms of the robot")
    def joint_terms(self) -> str | None:
        """Joint terms (nv,), unknown plus given; a sensor behind the joints does not measure
        them."""
        robot, task = self.case.robot, self.result
        if task.definition.measures_sensor_only:
            return None
        total = {term: task.known_terms[term].copy() for term in SUFFIX}
        for name, value in self._unknown_terms():
            term, dof, other = robot.resolve_term(name)
            # Friction between two joints is not a term of one of them.
            total[term][dof] += value if other is None else 0.0
        wrong = [t for t in SUFFIX if not np.allclose(total[t], getattr(robot.joint_terms, t))]
        if not wrong:
            return None
        return f"unknown and given joint terms differ from the robot's: {', '.join(wrong)}"
