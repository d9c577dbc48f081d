"""Base maps: K is the identity on its pivots, pivots go from left to right, nothing is lost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench.identifiability.base_expressions import base_expressions
from sysid_bench.identifiability.base_map import base_map, structural_base
from sysid_bench.models.manifest import TERMS
from sysid_bench.models.robot import RobotModel
from sysid_bench.numerics import qr_factor
from sysid_bench.regressors.regression import regression
from sysid_bench.types import Array, BaseMap
from tests.robots import named_robot, random_robot, relative_gap, robot_of, states

SEEDS = st.integers(0, 2**32 - 1)


def matrix_of_rank(rng: np.random.Generator, rows: int, columns: int, rank: int) -> Array:
    """A matrix with `rank` independent columns; the others mix those to the left of them."""
    independent = np.sort(rng.permutation(columns)[:rank])
    W = np.zeros((rows, columns))
    for j in range(columns):
        known = independent[independent < j]
        if j in independent:
            W[:, j] = rng.normal(size=rows)
        elif len(known):
            W[:, j] = W[:, known] @ rng.normal(size=len(known))
    return W


@given(seed=SEEDS, columns=st.integers(1, 12))
def test_pivots_are_the_columns_that_no_earlier_ones_explain(seed: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    rank = int(rng.integers(0, columns + 1))
    W = matrix_of_rank(rng, 20, columns, rank)
    base = base_map(W, tuple(f"p{j}" for j in range(columns)))
    assert base.rank == rank
    for j in range(columns):
        ranks = [np.linalg.matrix_rank(W[:, :k]) if k else 0 for k in (j, j + 1)]
        grows = ranks[1] > ranks[0]
        assert (j in base.pivots) == grows
    np.testing.assert_allclose(W[:, base.pivots] @ base.K, W, atol=1e-9)
    np.testing.assert_array_equal(base.K[:, base.pivots], np.eye(rank))
    assert base.names == tuple(f"p{j}" for j in base.pivots)


@given(seed=SEEDS)
def test_the_gap_parts_what_is_kept_from_what_is_dropped(seed: int) -> None:
    rng = np.random.default_rng(seed)
    U, _ = np.linalg.qr(rng.normal(size=(20, 6)))
    V, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    base = base_map(U @ np.diag([3, 2, 1, 1e-7, 1e-8, 1e-15]) @ V, tuple("abcdef"))
    assert base.rank == 3
    assert base.near_degenerate == 2
    assert base.gap == pytest.approx(1e7, rel=1e-4)


def test_of_nearly_equal_columns_the_one_that_stands_out_is_the_pivot() -> None:
    """Columns b and c repeat a but for 1e-9 and 1e-7; d is new and small: rank 2 is a and d."""
    x, y, z = np.eye(4)[:3]
    W = np.column_stack([x, x + 1e-9 * y, x + 1e-7 * z, 1e-3 * np.eye(4)[3]])
    base = base_map(W, ("a", "b", "c", "d"))
    assert base.names == ("a", "d")
    assert base.near_degenerate == 2
    np.testing.assert_allclose(base.K, [[1, 1, 1, 0], [0, 0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_zeros_report_nothing(rows: int) -> None:
    base = base_map(np.zeros((rows, 3)), ("a", "b", "c"))
    assert base.rank == 0
    assert base.K.shape == (0, 3)
    np.testing.assert_array_equal(base.embed(np.zeros(0)), np.zeros(3))


@given(scale=st.floats(1e-6, 1e6))
def test_a_common_scale_changes_nothing(scale: float) -> None:
    W = matrix_of_rank(np.random.default_rng(0), 20, 8, 5)
    names = tuple("abcdefgh")
    one, other = base_map(W, names), base_map(scale * W, names)
    np.testing.assert_array_equal(one.pivots, other.pivots)
    np.testing.assert_allclose(one.K, other.K, atol=1e-9)


MAPPED = ("ur5", "panda", "kinova", "solo12", "tree 0", "tree 4")


@pytest.fixture(scope="module", params=MAPPED)
def mapped(request: pytest.FixtureRequest) -> tuple[RobotModel, BaseMap]:
    name = request.param
    robot = random_robot(int(name.split()[1])) if name.startswith("tree") else named_robot(name)
    return robot, structural_base(robot, robot.inertial_columns + robot.term_columns(TERMS))


def test_the_map_holds_on_states_it_has_not_seen(mapped: tuple[RobotModel, BaseMap]) -> None:
    robot, base = mapped
    Y = regression(robot, base.parameters).dense(states(robot, 20, seed=77)).Y
    assert relative_gap(Y[:, :, base.pivots] @ base.K, Y) < 1e-9
    np.testing.assert_array_equal(base.K[:, base.pivots], np.eye(base.rank))
    assert (np.diff(base.pivots) > 0).all()


def test_a_column_is_no_pivot_iff_earlier_ones_explain_it(
    mapped: tuple[RobotModel, BaseMap],
) -> None:
    robot, base = mapped
    count = 30 + 2 * len(base.parameters) // robot.nv
    Y = regression(robot, base.parameters).dense(states(robot, count, seed=78)).Y
    W = qr_factor([Y.reshape(-1, Y.shape[-1])])  # the same dependences in fewer rows
    pivots = np.linalg.qr(W[:, base.pivots])[0]
    for j in range(W.shape[1]):
        earlier = pivots[:, base.pivots < j]  # their span, whatever comes after them
        rest = W[:, j] - earlier @ (earlier.T @ W[:, j])
        dependent = np.linalg.norm(rest) < 1e-7 * np.linalg.norm(W, 2)
        assert dependent == (j not in base.pivots)


def test_base_parameters_embedded_give_the_same_torques(mapped: tuple[RobotModel, BaseMap]) -> None:
    robot, base = mapped
    theta = np.random.default_rng(5).normal(size=len(base.parameters))
    ours = regression(robot, base.parameters)
    motion = states(robot, 10, seed=79)
    again = base.embed(base.K @ theta)
    assert np.count_nonzero(again) <= base.rank
    assert relative_gap(ours.torque(motion, again), ours.torque(motion, theta)) < 1e-9


def test_what_no_column_sees_changes_no_torque(mapped: tuple[RobotModel, BaseMap]) -> None:
    """The nullspace of K is the nullspace of every Y."""
    robot, base = mapped
    _, _, Vt = np.linalg.svd(base.K)
    unseen = Vt[base.rank :]
    Y = regression(robot, base.parameters).dense(states(robot, 10, seed=80)).Y
    assert len(unseen) > 0
    assert np.abs(Y @ unseen.T).max() < 1e-9 * np.abs(Y).max()


@settings(max_examples=10)
@given(seed=SEEDS)
def test_the_order_of_columns_changes_the_pivots_and_not_the_rank(seed: int) -> None:
    robot = named_robot("ur5")
    shuffled = np.random.default_rng(seed).permutation(robot.inertial_columns)
    assert structural_base(robot, tuple(shuffled.tolist())).rank == 36


def test_a_structural_map_is_the_same_every_time() -> None:
    robot = named_robot("ur5")
    one, other = (structural_base(robot, robot.inertial_columns) for _ in range(2))
    np.testing.assert_array_equal(one.K, other.K)
    np.testing.assert_array_equal(one.singular_values, other.singular_values)


def test_coefficients_of_rounded_angles_are_not_printed() -> None:
    """1.5708 instead of pi / 2 turns an axis by 3.7e-6, and leaves coefficients of that size."""
    body = '<joint axis="0 0 1"/><geom size=".1" mass="1" pos="0.1 0 0"/>'
    arm = (
        f'<mujoco><compiler angle="radian"/><worldbody><body>{body}'
        f'<body pos="0.3 0 0.2" euler="{{angle}} 0 0">{body}'
        f'<body pos="0.3 0.1 0.2" euler="{{angle}} 0 0">{body}</body></body></body>'
        "</worldbody></mujoco>"
    )
    robots = [robot_of(arm.format(angle=angle)) for angle in (repr(np.pi / 2), "1.5708")]
    exact, rounded = (
        base_expressions(structural_base(robot, robot.inertial_columns)) for robot in robots
    )
    assert [terms.keys() for terms in rounded] == [terms.keys() for terms in exact]
