"""Laws of designs for coupled joints and closed chains: the joints that follow are known to all."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.excitation.collision_model import collision_model
from sysid_bench.excitation.design_cost import DesignCost
from sysid_bench.excitation.design_problem import DesignProblem, design_problem
from sysid_bench.excitation.information import information_model, torque_model
from sysid_bench.excitation.optimised import (
    Optimised,
    design_criterion,
    design_figures,
    excitation_parameters,
)
from sysid_bench.experiments.tasks.task import task_of
from sysid_bench.identifiability.base_map import structural_base
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.inverse import Inverse
from sysid_bench.simulation.plant import plant_of
from sysid_bench.types import Trajectory
from tests.coupling.mechanisms import KINDS, mechanism
from tests.robots import named_robot

QUICK = {"harmonics": 2, "period": 5.0, "iterations": 6}
SHIPPED = ("dvrk_psm", "dvrk_mtm")
# Designs of closed chains take seconds each.
LONG = [
    pytest.param(name, marks=pytest.mark.long)
    for name in (*KINDS, "dvrk_psm")
    if name != "geared-pair"
]


def robot_called(name: str) -> RobotModel:
    return named_robot(name) if name in SHIPPED else mechanism(name, 7)


def briefed(
    robot: RobotModel, terms: tuple[str, ...] = (), margin: float = 1.1
) -> tuple[DesignProblem, Trajectory]:
    """A brief in which torques are limited, and all that followers do: to what a random motion
    does, times `margin`; and that motion."""
    base = structural_base(robot, robot.inertial_columns + robot.term_columns(terms))
    given = replace(
        design_problem(robot, 100.0),
        regress=information_model(robot, base.names),
        torque=torque_model(robot),
        scene=partial(collision_model, robot),
    )
    made = Optimised(**QUICK)  # type: ignore[arg-type]
    space = made.space(given)
    motion = space.motion(space.random(np.random.default_rng(9), 0.9), space.curves.grid())
    assert given.torque is not None
    assert given.coupling is not None
    after = given.coupling.dependent
    q = motion.q[:, given.coupling.qadr[after]]
    bounds = [q.min(axis=0) - 0.1, q.max(axis=0) + 0.1]
    bounds += [margin * np.abs(x[:, after]).max(axis=0) + 1e-3 for x in (motion.v, motion.a)]
    narrow = replace(
        given,
        tau=margin * np.abs(given.torque.of(motion)).max(axis=0) + 1e-3,
        coupling=replace(given.coupling, bounds=np.array(bounds)),
    )
    return narrow, motion


@pytest.mark.parametrize("name", [*KINDS, *SHIPPED])
def test_slopes_pass_through_the_joints_that_follow(name: str) -> None:
    robot = robot_called(name)
    given, _ = briefed(robot, ("viscous", "coulomb", "spring", "armature"))
    made = Optimised({"D": 1.0, "cond": 0.3}, **QUICK)  # type: ignore[arg-type]
    space, rng = made.space(given), np.random.default_rng(1)
    draws = [space.random(rng, 0.8) for _ in range(8)]
    assert given.regress is not None
    asked = excitation_parameters(space, given.regress, draws).smooth
    limits = made.limits(given)
    assert {"follower position", "follower acceleration", "torque"} <= {x.kind for x in limits}
    evaluation = DesignCost(
        space, asked, design_criterion(made.objective, asked, space, draws), limits
    )
    C, step = draws[0], 1e-6
    slope = evaluation.gradient(C)
    values, by_C = evaluation.smooth_limits(C, 60.0)
    near = values > 0.6  # farther ones are not looked at closer
    for i, j in [(0, 0), (1, 0), (3, -1), (4, -1)]:
        up, down = C.copy(), C.copy()
        up[i, j] += step
        down[i, j] -= step
        difference = (evaluation.value(up) - evaluation.value(down)) / (2 * step)
        assert abs(slope[i, j] - difference) <= 1e-5 * np.abs(slope).max() + 1e-6
        differences = (
            evaluation.smooth_limits(up, 60.0)[0] - evaluation.smooth_limits(down, 60.0)[0]
        ) / 2e-6
        pulled = by_C.reshape(-1, *C.shape)[:, i, j]
        atol = 1e-6 * np.abs(by_C).max()
        np.testing.assert_allclose(pulled[near], differences[near], atol=atol)


@pytest.mark.parametrize("name", ["geared-pair", *LONG])
def test_a_design_closes_and_keeps_the_limits_of_all_joints(name: str) -> None:
    robot = robot_called(name)
    given, known = briefed(robot, margin=1.5)
    made = Optimised("D", harmonics=2, period=5.0, iterations=8)
    design = made.solve(given, np.random.default_rng(0))
    space = made.space(given)
    assert given.regress is not None
    asked = excitation_parameters(
        space, given.regress, made.random_coefficients(space, np.random.default_rng(0))
    )
    best = space.motion(design.C, space.curves.grid())
    assert design_figures(asked, best)["log_det"] > design_figures(asked, known)["log_det"]
    assert all(used.use <= 1.0 for used in made.report(design.C, given).values())
    fine = made.motion(design.C, given.at(500.0))
    assert given.coupling is not None
    closed = robot.completed(fine)
    for ours, theirs in ((fine.q, closed.q), (fine.v, closed.v), (fine.a, closed.a)):
        np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.abs(theirs).max())
    after = given.coupling.dependent
    low, high, v, a = given.coupling.bounds
    q = fine.q[:, given.coupling.qadr[after]]
    assert (q >= low).all()
    assert (q <= high).all()
    assert (np.abs(fine.v[:, after]) <= v).all()
    assert (np.abs(fine.a[:, after]) <= a).all()
    oracle, _ = Inverse().run(plant_of(robot, []), fine, np.zeros((len(fine), given.nv)))
    # What MuJoCo says it takes, on the joints that move, is what the limits looked at.
    assert (np.abs(oracle.tau) <= given.tau).all()


def test_a_joint_that_follows_is_not_designed() -> None:
    given, _ = briefed(mechanism("geared-pair", 7))
    with pytest.raises(UsageError, match="'driven' follows drive"):
        Optimised(joints=("driven",)).space(given)


@pytest.mark.parametrize(("name", "sensor"), [("ur5", "wrist_1_link"), ("dvrk_psm", "link3")])
def test_a_design_is_for_what_a_sensor_sees_too(name: str, sensor: str) -> None:
    robot = named_robot(name)
    asked = task_of(robot, "wrench", (), sensor)
    base = structural_base(robot, asked.parameters, asked.rows, asked.cuts)
    given = replace(
        design_problem(robot, 100.0),
        regress=information_model(robot, base.names, asked.rows, asked.cuts),
    )
    made = Optimised("D", harmonics=2, period=5.0, iterations=10)
    space, rng = made.space(given), np.random.default_rng(1)
    draws = [space.random(rng, 0.8) for _ in range(3)]
    assert given.regress is not None
    seen = excitation_parameters(space, given.regress, draws).smooth
    evaluation = DesignCost(
        space, seen, design_criterion("D", seen, space, draws), made.limits(given)
    )
    C, step = draws[0], 1e-6
    slope = evaluation.gradient(C)
    for i, j in [(1, 0), (3, -1)]:
        up, down = C.copy(), C.copy()
        up[i, j] += step
        down[i, j] -= step
        difference = (evaluation.criterion_value(up) - evaluation.criterion_value(down)) / (
            2 * step
        )
        assert abs(slope[i, j] - difference) <= 1e-5 * np.abs(slope).max() + 1e-6
    design = made.solve(given, np.random.default_rng(0))
    assert design.value < design.start
