"""The check passes the built-in tasks, and names what is wrong with broken ones."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sysid_bench.apps.conformance import failed_checks
from sysid_bench.apps.conformance.task_checks import TaskProblem, check_task
from sysid_bench.errors import UnsupportedError
from sysid_bench.experiments.tasks.definitions import RobotTask
from sysid_bench.experiments.tasks.task import SensorOffset, Task, TaskDefinition, find_task
from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import BUILTIN
from sysid_bench.pytest_plugin import assert_conforms
from sysid_bench.types import Truth
from tests.robots import named_robot


def assert_sound(task: TaskDefinition, case: TaskProblem) -> None:
    """The task applies to the case and keeps its laws there."""
    assert failed_checks(check_task(task, [case])) == []


def broken(task: TaskDefinition, terms: tuple[str, ...] = ()) -> str:
    """Violated laws on a panda without payload, in words."""
    case = TaskProblem("panda", named_robot("panda", "none"), terms)
    return "\n".join(failed_checks(check_task(task, [case])))


@pytest.mark.parametrize("name", BUILTIN["task"])
def test_built_in_tasks_conform(name: str) -> None:
    assert_conforms(name, "task")


@pytest.mark.parametrize("robot", ["ur5", "panda", "solo12"])
@pytest.mark.parametrize("name", ["robot", "payload", "terminal", "link"])
def test_tasks_on_joint_torques_are_sound(name: str, robot: str) -> None:
    loaded, task = named_robot(robot, "sphere-offset-1kg"), find_task(name)
    for terms in ((), ("viscous", "coulomb")) if task.accepts_terms else ((),):
        assert_sound(task, TaskProblem(robot, loaded, terms))


@pytest.mark.parametrize("name", ["wrench", "wrench-payload", "robot", "payload"])
def test_tasks_with_a_sensor_are_sound(name: str) -> None:
    robot = load_robot("icub", PAYLOADS["box-2kg"])
    sensor = next(s.name for s in robot.manifest.sensors if s.name.startswith("l_arm"))
    assert_sound(find_task(name), TaskProblem("icub", robot, (), sensor))


def test_every_builtin_task_declares_its_own_name() -> None:
    assert [find_task(name).name for name in BUILTIN["task"]] == list(BUILTIN["task"])


@dataclass(frozen=True)
class Broken(RobotTask):
    """The task `robot` with one part changed."""

    change: Callable[[Task], Task] = lambda task: task

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        return self.change(super().unknowns(robot, terms, sensor, offset))


def heavier(task: Task) -> Task:
    theta = task.truth.theta.copy()
    theta[-4] += 0.1
    return replace(task, truth=Truth(task.parameters, theta))


def not_finite(task: Task) -> Task:
    return replace(task, truth=Truth(task.parameters, np.full(len(task.parameters), np.nan)))


def renamed(name: str) -> Callable[[Task], Task]:
    def change(task: Task) -> Task:
        return replace(task, truth=Truth((*task.parameters[:-1], name), task.truth.theta))

    return change


def forgets_friction(task: Task) -> Task:
    return replace(task, known_terms={k: 0.0 * v for k, v in task.known_terms.items()})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (heavier, "do not add up to those of the robot"),
        (not_finite, "not finite"),
        (renamed("nothing.m"), "missing"),
        (forgets_friction, "joint terms differ"),
    ],
)
def test_a_broken_task_is_named(change: Callable[[Task], Task], message: str) -> None:
    assert message in broken(Broken(change=change))


def test_unknowns_must_be_unique_and_of_the_robot() -> None:
    robot = named_robot("panda", "none")
    first = RobotTask().unknowns(robot, (), None, None).parameters[0]
    for name, message in ((first, "twice"), ("panda.mystery", "neither")):
        assert message in broken(Broken(change=renamed(name)), ("viscous",))


@dataclass(frozen=True)
class Raising(RobotTask):
    """The task `robot` that raises an error instead, or changes the robot."""

    error: Exception | None = None

    def unknowns(
        self,
        robot: RobotModel,
        terms: tuple[str, ...],
        sensor: str | None,
        offset: SensorOffset | None,
    ) -> Task:
        if self.error is not None:
            raise self.error
        task = super().unknowns(robot, terms, sensor, offset)
        robot.joint_terms.viscous[0] += 1.0
        return task


def test_an_error_of_a_task_is_a_finding() -> None:
    assert "poses its unknowns (panda): it raised KeyError" in broken(Raising(KeyError("arm")))
    assert "refused every robot" in broken(Raising(UnsupportedError("Only for hands.")))
    assert "is not derived from" in broken("robot")  # type: ignore[arg-type]


def test_a_task_leaves_the_robot_as_it_is() -> None:
    case = TaskProblem("panda", load_robot("panda"))  # of its own, not the one that tests share
    assert "leaves its input unchanged (panda)" in "\n".join(
        failed_checks(check_task(Raising(), [case]))
    )
