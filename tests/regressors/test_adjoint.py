"""Laws of the adjoint: the slopes of Y are its differences, on any tree."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.kernel_pullback import pullback, pullback_torque, smooth_regression
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.types import Array, Trajectory
from tests.random_trees import random_texts
from tests.robots import named_robot, robot_of, states

STEP = 1e-6
ALL_TERMS = ("viscous", "coulomb", "offset", "armature", "spring")


def by_differences(robot: RobotModel, motion: Trajectory, value) -> Slopes:  # type: ignore[no-untyped-def]
    """Slopes (N, nv) by q, v, a of a number per sample, value(motion) (N,), hinges and slides."""
    out = []
    for field in ("q", "v", "a"):
        slope = np.zeros_like(motion.v)
        for joint in robot.joints:
            if joint.kind not in ("hinge", "slide"):
                continue
            place = joint.qadr if field == "q" else joint.vadr
            up, down = (getattr(motion, field).copy() for _ in range(2))
            up[:, place] += STEP
            down[:, place] -= STEP
            difference = value(replace(motion, **{field: up})) - value(
                replace(motion, **{field: down})
            )
            slope[:, joint.vadr] = difference / (2 * STEP)
        out.append(slope)
    return out[0], out[1], out[2]


def assert_slopes_agree(robot: RobotModel, ours: Slopes, theirs: Slopes) -> None:
    scalar = robot.scalar_dofs
    scale = max(float(np.abs(x[:, scalar]).max(initial=0.0)) for x in theirs) or 1.0
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine[:, scalar], other[:, scalar], atol=2e-6 * scale, rtol=0)


def weighted(columns: Regression, G: Array):  # type: ignore[no-untyped-def]
    return lambda motion: (columns.dense(motion).Y * G).sum(axis=(1, 2))


@given(text=random_texts(6), seed=st.integers(0, 999))
@settings(max_examples=25, deadline=None)
def test_slopes_of_the_regressor_are_its_differences_on_any_tree(text: str, seed: int) -> None:
    robot = robot_of(text)
    motion = states(robot, 3, seed)
    names = robot.inertial_columns + robot.term_columns(ALL_TERMS)
    columns = smooth_regression(regression(robot, names))
    G = np.random.default_rng(seed).normal(size=(3, robot.nv, len(names)))
    ours = pullback(columns, motion, G)
    assert_slopes_agree(robot, ours, by_differences(robot, motion, weighted(columns, G)))


@pytest.mark.parametrize("name", ["ur5", "panda", "icub"])
def test_slopes_on_chosen_columns_of_named_robots(name: str) -> None:
    robot = named_robot(name, "box-2kg")
    motion = states(robot, 2, 1)
    names = robot.inertial_columns[3::7]
    columns = regression(robot, names)
    G = np.random.default_rng(2).normal(size=(2, robot.nv, len(names)))
    ours = pullback(columns, motion, G)
    assert_slopes_agree(robot, ours, by_differences(robot, motion, weighted(columns, G)))


@given(text=random_texts(5), seed=st.integers(0, 999))
@settings(max_examples=15, deadline=None)
def test_slopes_of_torque_are_its_differences(text: str, seed: int) -> None:
    robot = robot_of(text)
    motion = states(robot, 3, seed)
    phi = robot.tree.link_parameters(robot.phi)
    U = np.random.default_rng(seed).normal(size=motion.v.shape)

    def value(moved: Trajectory) -> Array:
        return np.asarray((newton_euler(robot.tree, phi, moved) * U).sum(axis=1))

    ours = pullback_torque(robot.tree, phi, motion, U)
    assert_slopes_agree(robot, ours, by_differences(robot, motion, value))


def test_the_smooth_sign_is_the_sign_away_from_standstill() -> None:
    robot = named_robot("ur5")
    names = robot.term_columns(("coulomb",))
    motion = states(robot, 50)
    fast = replace(motion, v=np.where(np.abs(motion.v) < 1.0, 1.0, motion.v))
    sharp = regression(robot, names).dense(fast).Y
    np.testing.assert_allclose(
        smooth_regression(regression(robot, names)).dense(fast).Y, sharp, atol=1e-9
    )
