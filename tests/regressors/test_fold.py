"""Folding keeps all that least squares needs, whatever the block size, in constant memory."""

import tracemalloc

import numpy as np
import pytest

from sysid_bench.models.manifest import TERMS
from sysid_bench.models.robot import RobotModel
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors import kernel_numpy as kernel
from sysid_bench.regressors.block_qr import MotionBlocks, motion_factors
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.types import Array
from tests.robots import named_robot, random_robot, relative_gap, robot_of, states

COUNTS = (1, 2, 1023, 1024, 1025)


def gram(R: Array) -> Array:
    return np.asarray(R.T @ R)


@pytest.fixture(scope="module", params=["ur5", "solo12", "tree"])
def robot(request: pytest.FixtureRequest) -> RobotModel:
    return random_robot(3, 4) if request.param == "tree" else named_robot(request.param)


@pytest.mark.parametrize("count", COUNTS)
def test_every_factor_has_the_gram_matrix_of_its_rows(
    robot: RobotModel, count: int, kernel_name: str
) -> None:
    ours = regression(robot, robot.inertial_columns + robot.term_columns(TERMS))
    motion = states(robot, count)
    b = np.random.default_rng(count).normal(size=(count, robot.nv))
    Y = ours.dense(motion).Y
    factors = motion_factors(ours, motion, b)
    assert tuple(factor.row for factor in factors) == robot.rows
    for i, factor in enumerate(factors):
        rows = np.column_stack([Y[:, i, factor.columns], b[:, i]])
        assert factor.samples == count
        assert len(factor.R) <= min(rows.shape)
        np.testing.assert_array_equal(factor.R, np.triu(factor.R))
        assert relative_gap(gram(factor.R), gram(rows)) < 1e-12


def test_block_sizes_do_not_matter(
    robot: RobotModel, kernel_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = regression(robot, robot.inertial_columns)
    motion = states(robot, 100)
    b = np.random.default_rng(0).normal(size=(100, robot.nv))
    whole = motion_factors(ours, motion, b)
    for size in (1, 33, 99, 100, 101):
        monkeypatch.setattr(kernel.blocks, "__defaults__", (size,))
        for one, other in zip(whole, motion_factors(ours, motion, b), strict=True):
            np.testing.assert_array_equal(one.columns, other.columns)
            assert one.samples == other.samples
            assert relative_gap(gram(other.R), gram(one.R)) < 1e-12


def test_dense_blocks_are_the_rows_again(robot: RobotModel, kernel_name: str) -> None:
    ours = regression(robot, robot.inertial_columns)
    motion = states(robot, 1025)
    b = np.random.default_rng(0).normal(size=(1025, robot.nv))
    parts = list(MotionBlocks(ours, motion, b, tuple(range(robot.nv)))())
    assert len(parts) == 2
    Y = ours.dense(motion).Y
    np.testing.assert_array_equal(np.concatenate([block for block, _ in parts]), Y)
    np.testing.assert_array_equal(np.concatenate([part for _, part in parts]), b)


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (2, 3), (3, 3), (50, 3), (5, 0), (4, 1)])
def test_a_triangle_has_the_gram_matrix_of_its_parts(shape: tuple[int, int]) -> None:
    stack = np.random.default_rng(0).normal(size=shape)
    R = qr_factor([stack[: len(stack) // 3], stack[len(stack) // 3 :]])
    assert R.shape == (min(shape), shape[1])
    np.testing.assert_allclose(gram(R), gram(stack), atol=1e-12)
    np.testing.assert_array_equal(R, np.triu(R))


def test_folding_leaves_its_inputs_alone(kernel_name: str) -> None:
    robot = named_robot("ur5")
    motion = states(robot, 20)
    stack, b = np.random.default_rng(0).normal(size=(2, 20, 6))
    before = stack.copy(), b.copy(), motion.q.copy()
    qr_factor([stack])
    motion_factors(regression(robot, robot.inertial_columns), motion, b)
    for array, copy in zip((stack, b, motion.q), before, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_memory_does_not_grow_with_the_motion(kernel_name: str) -> None:
    robot = robot_of(
        """<mujoco><worldbody><body><joint axis="0 1 0"/>
        <inertial pos=".1 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    )
    ours = regression(robot, robot.inertial_columns)
    block = 10 * kernel.BLOCK * 8  # of one row
    short, long = (_peak(ours, robot, blocks * kernel.BLOCK) for blocks in (3, 60))
    assert long < 1.1 * short + 0.1 * block
    if kernel_name == "numpy":
        assert short > block  # one block is seen at all


def _peak(ours: Regression, robot: RobotModel, count: int) -> int:
    motion = states(robot, count)
    b = np.zeros((count, 1))
    tracemalloc.start()
    try:
        motion_factors(ours, motion, b)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
