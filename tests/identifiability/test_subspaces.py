"""Identifiable subspaces behind a force/torque sensor: Traversaro et al. (2015), section IV."""

from dataclasses import replace

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.identifiability.subspaces import (
    Subspaces,
    basis_residual,
    excitation_of,
    row_space,
    structural_subspaces,
)
from sysid_bench.models.random_robot import random_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.models.sensor import subtree_at
from sysid_bench.regressors.wrench import subtree_regressor
from sysid_bench.types import Trajectory
from tests.robots import named_robot, revolute_tree, robot_of, states

ANGLE = 1e-10

CUTS = {
    "l_arm_ft_sensor": ((), 38, 28, 5),
    "r_arm_ft_sensor": ((), 38, 28, 5),
    "l_leg_ft_sensor": (("l_foot_ft_sensor",), 38, 28, 5),
    "r_leg_ft_sensor": ((), 38, 28, 5),
    "l_foot_ft_sensor": ((), 10, 0, 1),
    "base_link": ((), 234, 224, 33),
}
"""Place: further sensors, dimension of I_Yn, of I_Yc for every base, number of bases."""


def assert_lemma_and_proposition(found: Subspaces) -> None:
    """Lemma 1: I_Yn is the same for every base. Proposition 1: I_Yc is a subspace of I_Yn."""
    for wrench in found.wrenches.values():
        assert found.wrench.shape == wrench.shape
        assert basis_residual(found.wrench, wrench) < ANGLE
        assert basis_residual(wrench, found.wrench) < ANGLE
    for torque in found.torques.values():
        assert basis_residual(found.wrench, torque) < ANGLE


@pytest.mark.parametrize(
    "at", [pytest.param(at, marks=pytest.mark.long) if at == "base_link" else at for at in CUTS]
)
def test_the_icub_has_the_dimensions_of_its_sub_trees(at: str) -> None:
    others, wrench, torque, bases = CUTS[at]
    robot = named_robot("icub")
    cut = subtree_at(robot, at, others)
    some = ("base_link", "l_hand", "head", "r_foot") if at == "base_link" else None
    found = structural_subspaces(robot, cut, some)
    assert found.rank == wrench
    assert {basis.shape[1] for basis in found.torques.values()} == {torque}
    assert len(found.torques) == (bases if some is None else len(some))
    assert_lemma_and_proposition(found)
    values = found.singular_values
    assert values[wrench - 1] > 1e-3 * values[0]
    assert values[wrench] < 1e-13 * values[0]


@pytest.mark.parametrize("joints", [1, 2, 4, 6])
def test_hinges_behind_a_sensor_add_seven_each(joints: int) -> None:
    robot = revolute_tree(joints, joints)
    found = structural_subspaces(robot, subtree_at(robot, robot.body_names[0]))
    assert found.rank == 10 + 7 * joints
    assert {basis.shape[1] for basis in found.torques.values()} == {7 * joints}


@pytest.mark.parametrize("seed", range(10))
def test_lemma_and_proposition_hold_for_every_link_of_any_tree(seed: int) -> None:
    robot = robot_of(random_robot(seed))
    cut = subtree_at(robot, robot.body_names[seed % len(robot.body_names)])
    found = structural_subspaces(robot, cut)
    assert_lemma_and_proposition(found)
    assert found.rank >= 10
    for basis in found.joints.values():
        assert basis_residual(found.wrench, basis) < ANGLE


def _moving(robot: RobotModel, names: tuple[str, ...], seed: int = 0) -> Trajectory:
    """States in which these joints alone move."""
    motion = states(robot, 200, seed)
    q, v, a = motion.q.copy(), motion.v.copy(), motion.a.copy()
    for joint in robot.joints:
        if joint.kind == "hinge" and joint.name not in names:
            q[:, joint.qadr] = q[0, joint.qadr]
            v[:, joint.vadr] = a[:, joint.vadr] = 0.0
    return replace(motion, q=q, v=v, a=a)


SHOULDER = ("l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw")
WRIST = ("l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw")
# A joint that moves is lost as well where joints behind it are locked: its load is another one in
# motions that bend them.
DATA = {
    "all seven": ((*SHOULDER, "l_elbow", *WRIST), 38, ()),
    "wrist locked": (("l_shoulder_pitch", "l_shoulder_yaw", "l_elbow"), 17, ("l_elbow", *WRIST)),
    "shoulder": (SHOULDER, 10, ("l_elbow", *WRIST)),
}


@pytest.mark.parametrize("case", DATA)
def test_a_locked_joint_is_named_before_its_torque_is_trusted(case: str) -> None:
    names, rank, lost = DATA[case]
    robot = named_robot("icub")
    cut = subtree_at(robot, "l_arm_ft_sensor")
    excitation = excitation_of(
        subtree_regressor(robot, cut, _moving(robot, names)), structural_subspaces(robot, cut)
    )
    assert (excitation.rank, excitation.structural) == (rank, 38)
    assert excitation.unpredictable == lost
    assert excitation._is_complete == (not lost)
    assert bool(excitation.warning) == bool(lost)
    for name in lost:
        assert name in excitation.warning
        assert excitation.missing[name] > 0.9


@pytest.mark.parametrize("seed", range(6))
def test_what_the_data_excite_predicts_what_is_not_flagged(seed: int) -> None:
    """Two parameter sets that the data cannot distinguish give the same torque of every joint that
    is not flagged, in any other motion and for any base; those of flagged ones differ."""
    robot = revolute_tree(seed, 6)
    rng = np.random.default_rng(seed)
    cut = subtree_at(robot, robot.body_names[0])
    moved = tuple(rng.choice(robot.rows[6:], 3, replace=False))
    made = subtree_regressor(robot, cut, _moving(robot, moved, seed))
    excitation = excitation_of(made, structural_subspaces(robot, cut))
    basis, _ = row_space(made.Y_n)
    change = np.array(rng.normal(size=made.Y_n.shape[-1:]))
    change = change - basis @ (basis.T @ change)
    assert np.abs(made.Y_n @ change).max() < 1e-10
    other = subtree_regressor(robot, cut, states(robot, 50, seed + 1))
    bases = [robot.body_names[b] for b in cut.bodies]
    errors = np.max([np.abs(other.joint_torque(b) @ change).max(axis=0) for b in bases], axis=0)
    for row, size in zip(other.rows, errors, strict=True):
        assert (size > 1e-6) == (row in excitation.unpredictable), row


def test_apart_and_outside_are_sines() -> None:
    x, y, z = np.eye(3)[:, :, None]
    tilted = np.cos(0.1) * x + np.sin(0.1) * y
    assert basis_residual(x, tilted) == pytest.approx(np.sin(0.1))
    assert basis_residual(np.hstack([x, y]), np.hstack([tilted, z])) == pytest.approx(1.0)
    assert basis_residual(x, np.hstack([x, y])) == pytest.approx(1.0)
    assert basis_residual(np.hstack([x, y]), x) == pytest.approx(0.0, abs=1e-15)
    assert basis_residual(np.hstack([x, y]), tilted) == pytest.approx(0.0, abs=1e-15)


def test_data_of_another_sub_tree_are_refused() -> None:
    robot = named_robot("icub")
    arm, foot = subtree_at(robot, "l_arm_ft_sensor"), subtree_at(robot, "l_foot_ft_sensor")
    with pytest.raises(UsageError, match="columns"):
        excitation_of(
            subtree_regressor(robot, foot, states(robot, 5)), structural_subspaces(robot, arm)
        )
