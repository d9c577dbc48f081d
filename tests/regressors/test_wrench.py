"""Y_n and Y_c of sub-trees behind a sensor, against Pinocchio and MuJoCo's own sensors."""

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import subtree_at
from sysid_bench.regressors.pinocchio_wrench import pinocchio_wrench_regressor
from sysid_bench.regressors.wrench import (
    base_wrench_regressor,
    joint_torque_regressor,
    subtree_regressor,
)
from tests.robots import (
    NAMED,
    named_robot,
    random_robot,
    relative_gap,
    revolute_tree,
    robot_of,
    states,
)

TOLERANCE = 1e-12


def _random(seed: int) -> RobotModel:
    from sysid_bench.models.random_robot import random_robot as any_robot

    return (robot_of(any_robot(seed)), random_robot(seed), revolute_tree(seed, 6))[seed % 3]


def _agrees(robot: RobotModel, at: str, bases: list[str], samples: int = 6, seed: int = 0) -> None:
    cut, motion = subtree_at(robot, at), states(robot, samples, seed)
    ours = subtree_regressor(robot, cut, motion)
    for base in bases:
        Y_n, Y_c = pinocchio_wrench_regressor(robot, cut, motion, base)
        assert Y_c.rows == ours.rows
        assert Y_n.columns == ours.columns
        assert relative_gap(ours.base_wrench(base), Y_n.Y) < TOLERANCE
        assert relative_gap(ours.joint_torque(base), Y_c.Y) < TOLERANCE


def test_every_base_of_the_icub_arm_agrees_with_pinocchio_rooted_there() -> None:
    robot = named_robot("icub")
    names = [robot.body_names[b] for b in subtree_at(robot, "l_arm_ft_sensor").bodies]
    assert len(names) == 9
    _agrees(robot, "l_arm_ft_sensor", names, 20)


@pytest.mark.parametrize("name", NAMED)
def test_robots_agree_wherever_they_are_cut(name: str) -> None:
    robot = named_robot(name)
    rng = np.random.default_rng(0)
    for body in rng.permutation(len(robot.body_names))[:2]:
        inside = subtree_at(robot, robot.body_names[body]).bodies
        bases = [robot.body_names[b] for b in rng.permutation(inside)[:3]]
        _agrees(robot, robot.body_names[body], bases)


@pytest.mark.parametrize("seed", range(18))
def test_any_tree_agrees_wherever_it_is_cut(seed: int) -> None:
    """Balls, slides, several joints per body, anchors, free roots, any gravity."""
    robot, rng = _random(seed), np.random.default_rng(seed)
    for body in rng.permutation(len(robot.body_names))[:3]:
        inside = subtree_at(robot, robot.body_names[body]).bodies
        bases = [robot.body_names[b] for b in rng.permutation(inside)[:3]]
        _agrees(robot, robot.body_names[body], bases, seed=seed)


@pytest.mark.parametrize("seed", range(8))
def test_torques_behind_the_sensor_are_those_of_the_whole_robot(seed: int) -> None:
    """With the base at the sensor, Y_c phi is the robot's torque; a base behind a joint knows the
    sensor's wrench alone to give the same: Y_c(beta) phi + M f_b."""
    from sysid_bench.regressors.kernel_numpy import newton_euler

    robot = _random(seed)
    motion = states(robot, 5)
    tau = newton_euler(robot.tree, robot.tree.link_parameters(robot.phi), motion)
    cut = subtree_at(robot, robot.body_names[seed % len(robot.body_names)])
    made = subtree_regressor(robot, cut, motion)
    phi = robot.phi[list(cut.bodies)].ravel()
    truth = tau[:, list(made.dofs)]
    np.testing.assert_allclose(made.Y_c @ phi, truth, atol=1e-10 * (1 + np.abs(tau).max()))
    f_b = made.Y_n @ phi
    for b in cut.bodies:
        base = robot.body_names[b]
        there = np.einsum("nkc,nc->nk", made.jacobian(base), f_b)
        np.testing.assert_allclose(
            made.joint_torque(base) @ phi + there, truth, atol=1e-9 * (1 + np.abs(tau).max())
        )


def test_columns_and_rows_are_named() -> None:
    robot = named_robot("icub")
    cut, motion = subtree_at(robot, "l_arm_ft_sensor"), states(robot, 2)
    at_sensor = base_wrench_regressor(robot, cut, motion)
    at_hand = base_wrench_regressor(robot, cut, motion, "l_hand")
    torque = joint_torque_regressor(robot, cut, motion, "l_hand")
    assert at_sensor.rows[0] == "l_arm_ft_sensor.nx"
    assert at_hand.rows[5] == "l_hand.fz"
    assert torque.rows == ("l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw")
    assert at_sensor.columns[0] == "l_upper_arm.m"
    assert at_sensor.Y.shape == (2, 6, 90)


def test_a_base_upstream_is_refused_with_what_there_is() -> None:
    robot = named_robot("icub")
    made = subtree_regressor(robot, subtree_at(robot, "l_arm_ft_sensor"), states(robot, 2))
    with pytest.raises(UsageError, match="l_upper_arm"):
        made.base_wrench("chest")
