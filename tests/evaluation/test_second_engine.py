"""MuJoCo's own inverse dynamics as second engine, where Pinocchio is not installed."""

import sys

import numpy as np
import pytest

from sysid_bench.commands.crosscheck import crosscheck as verdicts
from sysid_bench.evaluation.crosscheck import CLOSURE, GAP, crosscheck, relative_error
from sysid_bench.evaluation.second_engine import (
    reduced_reference,
    reference_regressor,
    second_engine,
    wrench_reference,
)
from sysid_bench.models.load import load_robot
from sysid_bench.models.random_states import random_states
from sysid_bench.models.sensor import subtree_at

TREES = ("ur5", "panda", "solo12", "scara", "random:3", "random:8", "random:11")
COUPLED = ("dvrk_psm", "random:four-bar:7")


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)


@pytest.mark.parametrize("name", TREES)
def test_both_engines_give_the_same_regressor(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot(name)
    motion = random_states(robot, 4, np.random.default_rng(5))
    theirs = reference_regressor(robot, motion)
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    ours = reference_regressor(robot, motion)
    assert second_engine() == "mujoco"
    assert (ours.rows, ours.columns) == (theirs.rows, theirs.columns)
    assert relative_error(ours.Y - theirs.Y, theirs.Y) <= GAP


@pytest.mark.parametrize("name", COUPLED)
def test_both_engines_reduce_closed_chains_alike(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = load_robot(name)
    motion = random_states(robot, 4, np.random.default_rng(5))
    theirs = reduced_reference(robot, motion)
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    assert relative_error(reduced_reference(robot, motion) - theirs, theirs) <= 1e-9


@pytest.mark.parametrize(("name", "at"), [("ur5", "wrist_3_link"), ("panda", "panda_link5")])
def test_both_engines_give_the_same_wrenches(
    name: str, at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = load_robot(name)
    motion = random_states(robot, 4, np.random.default_rng(5))
    cut = subtree_at(robot, at)
    theirs = wrench_reference(robot, cut, motion, robot.body_names[cut.body])
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    ours = wrench_reference(robot, cut, motion, robot.body_names[cut.body])
    assert (ours.rows, ours.columns) == (theirs.rows, theirs.columns)
    assert relative_error(ours.Y - theirs.Y, theirs.Y) <= GAP


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("name", ["ur5", "solo12", "dvrk_psm"])
def test_without_pinocchio_a_robot_is_checked_all_the_same(name: str) -> None:
    [verdict] = verdicts(name)
    assert verdict["ok"], verdict["reason"]
    assert verdict["engine"] == "mujoco"
    assert verdict["gap"] <= GAP
    assert verdict["closure"] <= CLOSURE
    assert "MuJoCo's own inverse dynamics" in verdict["native_reason"]
    assert "MuJoCo's own inverse dynamics" in verdict.summary()


@pytest.mark.usefixtures("alone")
def test_the_check_without_pinocchio_finds_a_wrong_regressor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from sysid_bench.evaluation import crosscheck as module

    honest = vars(module)["regression"]

    class Wrong:
        def __init__(self, *arguments: object) -> None:
            self.right = honest(*arguments)

        def dense(self, motion: object) -> object:
            found = self.right.dense(motion)
            found.Y[:, 1, 20:30] *= 1 + 1e-9
            return found

    monkeypatch.setattr(module, "regression", Wrong)
    assert not crosscheck(load_robot("ur5")).ok()
