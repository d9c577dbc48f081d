"""The check passes the built-in tasks, and names what is wrong with broken ones."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sysid_bench.models.load import load_robot
from sysid_bench.models.payload import PAYLOADS
from sysid_bench.models.robot import RobotModel
from sysid_bench.naming import BUILTIN
from sysid_bench.tasks.check_task import check_task
from sysid_bench.tasks.robot import RobotTask
from sysid_bench.tasks.task import SensorOffset, Task, named_task
from sysid_bench.types import Truth
from tests.robots import named_robot


@pytest.mark.parametrize("robot", ["ur5", "panda", "solo12"])
@pytest.mark.parametrize("name", ["robot", "payload", "terminal", "link"])
def test_tasks_on_joint_torques_are_sound(name: str, robot: str) -> None:
    loaded, task = named_robot(robot, "sphere-offset-1kg"), named_task(name)
    for terms in ((), ("viscous", "coulomb")) if task.accepts_terms else ((),):
        assert check_task(task, loaded, terms) == ()


@pytest.mark.parametrize("name", ["wrench", "wrench-payload", "robot", "payload"])
def test_tasks_with_a_sensor_are_sound(name: str) -> None:
    robot = load_robot("icub", PAYLOADS["box-2kg"])
    sensor = next(s.name for s in robot.manifest.sensors if s.name.startswith("l_arm"))
    assert check_task(named_task(name), robot, (), sensor) == ()


def test_every_builtin_task_declares_its_own_name() -> None:
    assert [named_task(name).name for name in BUILTIN["task"]] == list(BUILTIN["task"])


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
    assert message in " ".join(check_task(Broken(change=change), named_robot("panda", "none")))


def test_unknowns_must_be_unique_and_of_the_robot() -> None:
    robot = named_robot("panda", "none")
    first = RobotTask().unknowns(robot, (), None, None).parameters[0]
    for name, message in ((first, "twice"), ("panda.mystery", "neither")):
        task = Broken(change=renamed(name))
        assert message in " ".join(check_task(task, robot, ("viscous",)))
