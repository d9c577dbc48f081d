"""Verdicts, printed sums and other base sets, with the structural nullspace as the oracle."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_bench import package_folders
from sysid_bench.identifiability.base_expressions import (
    base_expressions,
    expression,
    left_out_expressions,
    parameter_verdict,
)
from sysid_bench.identifiability.base_map import (
    CONDITION,
    base_map,
    qr_columns,
    structural_base,
    structural_factor,
)
from sysid_bench.identifiability.nullspace import parameter_nullspace, structural_rank
from sysid_bench.models.load import load_robot
from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array, BaseMap
from tests.closeness import subspace_distance
from tests.robots import NAMED, named_robot, random_robot

SEEDS = st.integers(0, 2**32 - 1)
TREES = 500
MJCFS = 23


def inertial_base(robot: RobotModel) -> BaseMap:
    return structural_base(robot, robot.inertial_columns)


def reference_verdicts(nullspace: Array) -> tuple[str, ...]:
    """The verdict on each parameter, from the changes (p, k) that have no effect."""
    p = len(nullspace)
    unseen = np.linalg.norm(nullspace @ nullspace.T - np.eye(p), axis=1)  # of each unit vector
    moved = np.abs(nullspace).max(axis=1, initial=0.0)
    return tuple(
        "identifiable" if moved[j] < 1e-9 else "none" if unseen[j] < 1e-9 else "combination"
        for j in range(p)
    )


def row_space(nullspace: Array) -> Array:
    """What is left of the parameters' space: an orthonormal K (r, p)."""
    left, _, _ = np.linalg.svd(nullspace, full_matrices=True)
    return left[:, nullspace.shape[1] :].T


@pytest.mark.parametrize(
    "seeds", [range(100), pytest.param(range(100, TREES), marks=pytest.mark.long)]
)
def test_the_rank_of_random_trees_is_the_structural_one(seeds: range) -> None:
    for seed in seeds:
        robot = random_robot(seed, bodies=2 + seed % 4)
        assert inertial_base(robot).rank == structural_rank(robot.tree), seed


@pytest.mark.parametrize("name", NAMED)
def test_the_rank_of_named_robots_is_the_structural_one(name: str) -> None:
    robot = named_robot(name).without_coupling
    nullspace = parameter_nullspace(robot.tree)
    base = inertial_base(robot)
    assert base.rank + base.near_degenerate == len(nullspace) - nullspace.shape[1]
    # What the rank rule drops belongs to the structure as well.
    assert base.dropped is not None
    directions = base.dropped / np.linalg.norm(base.dropped, axis=1, keepdims=True)
    assert subspace_distance(np.vstack([base.K, directions]).T, row_space(nullspace).T) < 1e-8


@pytest.mark.data
def test_the_rank_of_the_mjcf_collection_is_the_structural_one(data_folder: Path) -> None:
    files = sorted((data_folder / "robots").glob("*.xml"))
    assert len(files) == MJCFS
    for file in files:
        robot = load_robot(file).without_coupling
        assert inertial_base(robot).rank == structural_rank(robot.tree), file.name


@pytest.mark.parametrize("file", ["so100.urdf", "so101.urdf"])
def test_directions_caused_by_rounding_are_named_and_make_up_the_difference(file: str) -> None:
    (path,) = package_folders.robot_data_folder().rglob(file)
    robot = load_robot(path)
    base, R = inertial_base(robot), structural_factor(robot, robot.inertial_columns)
    directions = left_out_expressions(R, base)
    assert base.rank + len(directions) == structural_rank(robot.tree)
    for value, terms in directions:
        assert 1e-12 < value < 1e-5
        assert set(terms) <= set(robot.inertial_columns)
        assert next(iter(terms.values())) == max(map(abs, terms.values()))


@pytest.mark.parametrize("seed", range(30))
def test_verdicts_of_random_trees_are_those_of_the_nullspace(seed: int) -> None:
    robot = random_robot(seed, bodies=4)
    nullspace = parameter_nullspace(robot.tree)
    base = inertial_base(robot)
    assert parameter_verdict(base) == reference_verdicts(nullspace)
    assert subspace_distance(base.K.T, row_space(nullspace).T) < 1e-8


ILL: Final = (1368, 2271, 2322, 3307)
"""Trees whose left-to-right base set has a condition of 1e7 and more."""


@pytest.mark.parametrize("seed", [*ILL, *range(100)])
def test_verdicts_of_generated_trees_are_those_of_the_nullspace(seed: int) -> None:
    robot = load_robot(f"random:{seed}")
    nullspace = parameter_nullspace(robot.tree)
    base = inertial_base(robot)
    assert base.rank == len(nullspace) - nullspace.shape[1]
    assert parameter_verdict(base) == reference_verdicts(nullspace)


@pytest.mark.parametrize("seed", [*ILL, *range(20)])
def test_a_base_set_bears_data(seed: int) -> None:
    robot = load_robot(f"random:{seed}")
    R = structural_factor(robot, robot.inertial_columns)
    base = base_map(R, robot.inertial_columns)
    assert base.rank == structural_rank(robot.tree) >= 20
    assert np.linalg.cond(R[:, base.pivots]) <= CONDITION
    np.testing.assert_allclose(R[:, base.pivots] @ base.K, R, atol=1e-9 * np.abs(R).max())


def test_the_rank_does_not_hang_on_how_far_a_joint_may_go(tmp_path: Path) -> None:
    ranks = []
    for reach in (2.0, 1e-4):
        file = tmp_path / f"{reach}.xml"
        file.write_text(
            f"""<mujoco><worldbody><body name="a"><joint name="a" axis="0 0 1" limited="true"
            range="-{reach} {reach}"/>
            <inertial pos=".1 .2 .3" mass="1" fullinertia="2 3 4 .1 .2 .3"/>
            <body name="b" pos="1 0 0"><joint name="b" axis="0 1 0" limited="true"
            range="-{reach} {reach}"/><inertial pos=".1 .2 .3" mass="1"
            fullinertia="2 3 4 .1 .2 .3"/></body></body></worldbody></mujoco>"""
        )
        ranks.append(inertial_base(load_robot(file)).rank)
    assert ranks[0] == ranks[1]


@pytest.mark.parametrize("name", ["ur5", "panda", "z1", "solo12"])
def test_verdicts_of_arms_are_those_of_the_nullspace(name: str) -> None:
    robot = named_robot(name)
    assert parameter_verdict(inertial_base(robot)) == reference_verdicts(
        parameter_nullspace(robot.tree)
    )


@given(seed=SEEDS)
def test_a_verdict_is_what_the_nullspace_of_a_matrix_does_to_a_parameter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(12, 6)) * (rng.random(6) > 0.2)
    W[:, 4] = 2.0 * W[:, 1] - W[:, 0] * (rng.random() > 0.5)
    base = base_map(W, tuple("abcdef"))
    _, values, Vt = np.linalg.svd(W)
    assert parameter_verdict(base) == reference_verdicts(Vt[(values > 1e-9).sum() :].T)


def test_sums_are_printed_as_papers_do() -> None:
    K = np.array([[1.0, 0.0, -1.0, 0.04, 0.0], [0.0, 1.0, 0.0, -2.5e-4, 1e-13]])
    names = ("link2.Ixx", "link2.Ixy", "link2.Iyy", "link3.m", "link3.hx")
    base = BaseMap(K, np.array([0, 1]), names, np.inf, 0, np.ones(2))
    assert tuple(map(expression, base_expressions(base))) == (
        "link2.Ixx - link2.Iyy + 0.04 link3.m",
        "link2.Ixy - 0.00025 link3.m",
    )
    assert parameter_verdict(base) == ("combination",) * 2 + ("combination",) * 2 + ("none",)
    assert expression({"a": 1.0, "b": 2 / 3}, digits=2) == "a + 0.67 b"


@pytest.mark.parametrize("name", ["ur5", "panda", "solo12"])
def test_printed_sums_are_the_base_map(name: str) -> None:
    base = inertial_base(named_robot(name))
    again = np.zeros_like(base.K)
    for i, terms in enumerate(base_expressions(base)):
        assert next(iter(terms)) == base.names[i]
        for parameter, value in terms.items():
            again[i, base.parameters.index(parameter)] = value
    np.testing.assert_allclose(again, base.K, atol=1e-8 * np.abs(base.K).max())


@pytest.mark.parametrize("name", ["ur5", "kinova", "solo12", "tree 3", "tree 8"])
def test_qr_pivots_span_the_same_space(name: str) -> None:
    robot = random_robot(int(name[5:])) if name.startswith("tree") else named_robot(name)
    R = structural_factor(robot, robot.inertial_columns)
    base = base_map(R, robot.inertial_columns)
    pivots = qr_columns(R, base.rank)
    K = np.linalg.solve(base.K[:, pivots], base.K)
    assert subspace_distance(base.K.T, K.T) < 1e-8
    np.testing.assert_allclose(R[:, pivots] @ K, R, atol=1e-8 * np.abs(R).max())
    assert np.argmax(np.linalg.norm(R, axis=0)) in pivots
    assert parameter_verdict(
        replace(base, K=K, pivots=pivots, row_space=None)
    ) == parameter_verdict(base)


def test_other_spaces_are_distinguished() -> None:
    K = inertial_base(named_robot("ur5")).K
    assert subspace_distance(K.T, K[:-1].T) == pytest.approx(np.pi / 2)
    assert subspace_distance(K[:0].T, K[:0].T) == 0.0
    moved = K.copy()
    moved[0, 0] += 0.1  # shoulder_link.m, which no torque depends on
    assert subspace_distance(K.T, moved.T) > 1e-3


def test_subspaces_are_compared_by_their_angle() -> None:
    a = np.array([[1.0], [0.0], [0.0]])
    b = np.array([[np.cos(0.3)], [np.sin(0.3)], [0.0]])
    assert subspace_distance(a, 5 * b) == pytest.approx(0.3)
    assert subspace_distance(np.hstack([a, b]), np.eye(3)[:, :2]) == pytest.approx(0.0, abs=1e-7)


@settings(max_examples=20)
@given(seed=SEEDS)
def test_a_mixture_of_base_parameters_spans_the_same_space(seed: int) -> None:
    K = inertial_base(named_robot("ur5")).K
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(K), len(K))))
    assert subspace_distance(K.T, (Q @ K).T) < 1e-9
