"""The compiled kernel is the NumPy kernel, on any tree, for any columns, any number of samples."""

import re
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sysid_bench.errors import UsageError
from sysid_bench.instruction_sets import LEVELS, VARIABLE
from sysid_bench.models.manifest import TERMS
from sysid_bench.models.robot import RobotModel
from sysid_bench.regressors import kernel_c as compiled
from sysid_bench.regressors.block_qr import factors_of_motions, motion_factors
from sysid_bench.regressors.kernel_c import SOURCE, KernelSelection, select_kernel
from sysid_bench.regressors.kernel_numpy import newton_euler
from sysid_bench.regressors.pinocchio import pinocchio_regressor
from sysid_bench.regressors.regression import Regression, regression
from sysid_bench.regressors.symbolic_regressor import c_source
from sysid_bench.types import Array, Trajectory
from tests.random_trees import random_texts
from tests.robots import NAMED, named_robot, random_robot, relative_gap, robot_of, states

Choose = Callable[[str], KernelSelection]
SAME = 1e-12
"""Largest difference of the two kernels, and to Pinocchio, relative to the largest number."""


@pytest.fixture(params=LEVELS)
def level(request: pytest.FixtureRequest, choose: Choose) -> str:
    """Every instruction set that this machine runs."""
    name: str = request.param
    choice = choose(name)
    if choice.library is None:
        pytest.skip(choice.reason)
    return name


def both(choose: Choose, level: str, function: Callable[[], Array]) -> tuple[Array, Array]:
    choose("numpy")
    expected = function()
    assert choose(level).library is not None
    return function(), expected


def every_column(robot: RobotModel) -> tuple[str, ...]:
    return robot.inertial_columns + robot.term_columns(TERMS)


def part_of(motion: Trajectory, samples: slice) -> Trajectory:
    return Trajectory(motion.t[samples], motion.q[samples], motion.v[samples], motion.a[samples])


@pytest.mark.parametrize("name", [*NAMED, *range(8)])
def test_both_kernels_say_the_same(name: str | int, level: str, choose: Choose) -> None:
    robot = named_robot(name) if isinstance(name, str) else random_robot(name, 12)
    motion = states(robot, 70)
    ours = regression(robot, every_column(robot))
    phi = robot.tree.link_parameters(robot.phi)

    def rows() -> Array:
        return np.concatenate([block.dense() for block in ours.blocks(motion)])

    assert relative_gap(*both(choose, level, rows)) <= SAME
    assert relative_gap(*both(choose, level, lambda: ours.dense(motion).Y)) <= SAME
    assert relative_gap(*both(choose, level, lambda: newton_euler(robot.tree, phi, motion))) <= SAME


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(text=random_texts(), seed=st.integers(0, 2**32 - 1))
def test_both_kernels_and_pinocchio_agree_on_any_tree(choose: Choose, text: str, seed: int) -> None:
    robot = robot_of(text)
    motion = states(robot, 11, seed)
    reference = pinocchio_regressor(robot, motion).Y
    ours = regression(robot, robot.inertial_columns)
    for kernel in ("numpy", "compiled"):
        if choose(kernel).library is None and kernel == "compiled":
            pytest.skip(select_kernel().reason)
        assert relative_gap(ours.dense(motion).Y, reference) <= SAME


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_columns_are_chosen_and_ordered_alike(level: str, choose: Choose, seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(seed % 5, 8)
    columns = rng.permutation(np.array(every_column(robot)))
    ours = regression(robot, tuple(columns[: rng.integers(1, len(columns) + 1)].tolist()))
    motion = states(robot, 9, seed)
    assert relative_gap(*both(choose, level, lambda: ours.dense(motion).Y)) <= SAME


@pytest.mark.parametrize("count", [0, 1, 7, 31, 32, 33, 63, 64, 65, 130])
def test_a_sample_does_not_know_its_place(count: int, level: str) -> None:
    """Whatever block it falls into, wherever a motion starts: the same bits."""
    robot = random_robot(3, 14)
    motion = states(robot, 140)
    ours = regression(robot, every_column(robot))
    whole = ours.dense(motion).Y
    start = min(10, 140 - count)
    part = part_of(motion, slice(start, start + count))
    np.testing.assert_array_equal(ours.dense(part).Y, whole[start : start + count])
    blocks = [block.dense() for block in ours.blocks(part)]
    np.testing.assert_array_equal(
        np.concatenate([*blocks, whole[:0]]), whole[start : start + count]
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_bound_sample_is_that_of_the_block(seed: int, kernel_name: str) -> None:
    """One sample a call, arguments bound once: the same bits, in the same memory."""
    robot = random_robot(seed, 12)
    ours, motion = regression(robot, every_column(robot)), states(robot, 70, seed)
    whole, sample = ours.dense(motion).Y, ours.sample()
    other = ours.sample()
    first = sample(motion.q[0], motion.v[0], motion.a[0])
    for k in (0, 69, 33, 33):
        at = sample(motion.q[k], motion.v[k].tolist(), motion.a[k])
        other(motion.q[1], motion.v[1], motion.a[1])
        if kernel_name == "numpy":  # whose sums depend on the number of samples
            assert relative_gap(at, whole[k]) <= SAME
        else:
            np.testing.assert_array_equal(at, whole[k])
        assert np.shares_memory(at, first)
    with pytest.raises(ValueError, match="broadcast"):
        sample(motion.q[0][:-1], motion.v[0], motion.a[0])


def test_large_outputs_take_another_way_out_to_the_same_values(level: str) -> None:
    robot = named_robot("ur5")
    ours = regression(robot, robot.inertial_columns)
    motion = states(robot, 4099)
    assert 8 * len(motion) * robot.nv * len(ours.columns) > 16 << 20
    small = [ours.dense(part_of(motion, slice(k, k + 1000))).Y for k in range(0, 4099, 1000)]
    np.testing.assert_array_equal(ours.dense(motion).Y, np.concatenate(small))


def test_strided_arrays_are_read_as_they_are(level: str) -> None:
    robot = named_robot("ur5")
    ours = regression(robot, robot.inertial_columns)
    motion = states(robot, 40)
    thin = part_of(motion, slice(None, None, 3))
    q, v, a = (np.asfortranarray(x) for x in (thin.q, thin.v, thin.a))
    fortran = Trajectory(thin.t, q, v, a)
    np.testing.assert_array_equal(ours.dense(fortran).Y, ours.dense(motion).Y[::3])


@pytest.mark.parametrize("turns", [0, 1, 1e3, 1e5, 1e7, 1e12, -1e7])
def test_angles_of_any_size_are_reduced(turns: float, level: str, choose: Choose) -> None:
    """Sine and cosine are NumPy's for any angle, also where the quick reduction would not do."""
    robot = named_robot("ur5")
    motion = states(robot, 40)
    motion.q[5:30] += turns
    ours = regression(robot, robot.inertial_columns)
    assert relative_gap(*both(choose, level, lambda: ours.dense(motion).Y)) <= SAME


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_number_that_is_none_stays_in_its_sample(bad: float, level: str) -> None:
    robot = named_robot("ur5")
    motion = states(robot, 40)
    ours = regression(robot, every_column(robot))
    good = ours.dense(motion).Y
    motion.q[17, 0] = bad
    Y = ours.dense(motion).Y
    assert np.isnan(Y[17]).any()
    np.testing.assert_array_equal(np.delete(Y, 17, axis=0), np.delete(good, 17, axis=0))
    factors = motion_factors(ours, states(robot, 300), np.full((300, 6), np.nan))
    assert all(np.isnan(factor.R[:, -1]).any() for factor in factors)


def test_a_free_base_far_away_loses_no_digits(level: str) -> None:
    """The regressor does not know where the robot stands."""
    robot = named_robot("solo12")
    motion = states(robot, 20)
    ours = regression(robot, robot.inertial_columns)
    near = ours.dense(motion).Y
    motion.q[:, :3] += [1e6, -1e5, 1e4]
    np.testing.assert_array_equal(ours.dense(motion).Y, near)


@pytest.mark.parametrize("count", [200, 64 * 5, 64 * 5 + 1])
def test_factors_are_those_of_lapack(count: int, level: str, choose: Choose) -> None:
    for robot in (named_robot("ur5"), random_robot(3, 8)):
        ours = regression(robot, every_column(robot))
        motion = states(robot, count)
        b = np.random.default_rng(1).normal(size=motion.v.shape)
        choose("numpy")
        expected = motion_factors(ours, motion, b)
        choose(level)
        for one, other in zip(motion_factors(ours, motion, b), expected, strict=True):
            np.testing.assert_array_equal(one.R, np.triu(one.R))
            np.testing.assert_array_equal(one.columns, other.columns)
            assert relative_gap(one.R.T @ one.R, other.R.T @ other.R) <= SAME


def test_only_the_rows_that_are_asked_for_are_folded(level: str) -> None:
    robot = named_robot("ur5")
    ours = regression(robot, every_column(robot))
    motion = states(robot, 200)
    b = np.random.default_rng(1).normal(size=motion.v.shape)
    every = motion_factors(ours, motion, b)
    for rows in ((5,), (4, 1), ()):
        some = motion_factors(ours, motion, b, rows)
        assert [factor.row for factor in some] == [robot.rows[i] for i in rows]
        for factor, i in zip(some, rows, strict=True):
            np.testing.assert_allclose(factor.R, every[i].R, atol=1e-12)


def pieces(ours: Regression, count: int, cuts: list[int]) -> list[tuple[Trajectory, Array]]:
    robot = named_robot("ur5")
    motion = states(robot, count)
    b = np.random.default_rng(1).normal(size=motion.v.shape)
    ends = [0, *cuts, count]
    spans = [slice(s, e) for s, e in pairwise(ends)]
    return [(part_of(motion, span), b[span]) for span in spans]


@pytest.mark.parametrize("cuts", [[], [3], [500], [1, 2, 3], [200, 203, 207], [0], [998]])
def test_many_motions_are_folded_as_one(cuts: list[int], kernel_name: str) -> None:
    robot = named_robot("ur5")
    ours = regression(robot, robot.inertial_columns)
    whole = factors_of_motions(ours, pieces(ours, 1000, []))
    parts = factors_of_motions(ours, iter(pieces(ours, 1000, cuts)))
    for one, other in zip(parts, whole, strict=True):
        assert one.samples == other.samples == 1000
        assert relative_gap(one.R.T @ one.R, other.R.T @ other.R) <= SAME


def test_no_motion_at_all_has_factors_without_rows(kernel_name: str) -> None:
    robot = named_robot("ur5")
    ours = regression(robot, robot.inertial_columns)
    factors = factors_of_motions(ours, [])
    assert tuple(factor.row for factor in factors) == ours.rows
    for factor in factors:
        assert factor.samples == 0
        assert factor.R.shape == (0, len(factor.columns) + 1)


def test_the_block_of_the_kernel_is_what_the_derivation_prints() -> None:
    function = re.search(r"void entries\(.*?\n}\n", SOURCE.read_text(), re.DOTALL)
    assert function is not None
    printed = re.search(r"prints them \*/\n(.*)    /\* end \*/\n}\n", function[0], re.DOTALL)
    assert printed is not None
    assert printed[1] == c_source()


# --- Which kernel it is --------------------------------------------------------------------------


def test_numpy_serves_where_it_is_asked_for(choose: Choose) -> None:
    choice = choose("numpy")
    assert choice.library is None
    assert str(choice) == f"NumPy (selected by {VARIABLE})"


def test_a_kernel_that_is_none_is_refused_with_those_that_are(choose: Choose) -> None:
    with pytest.raises(UsageError, match=r"'fortran'.*numpy, compiled, x86-64-v4"):
        choose("fortran")


def test_numpy_serves_where_nothing_was_compiled(
    choose: Choose, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compiled, "SOURCE", tmp_path / "kernel.c")
    for name in ("", "compiled", "x86-64-v3"):
        choice = choose(name)
        assert choice.library is None
        assert "C compiler" in choice.reason


def test_a_library_of_another_source_is_not_used(
    choose: Choose, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if choose("compiled").library is None:
        pytest.skip(select_kernel().reason)
    other = tmp_path / "kernel.c"
    other.write_bytes(SOURCE.read_bytes() + b"\n")
    for library in SOURCE.parent.glob("libregressor.*"):
        shutil.copy(library, tmp_path)
    monkeypatch.setattr(compiled, "SOURCE", other)
    choice = choose("compiled")
    assert choice.library is None
    assert "install the package again" in choice.reason


def test_a_file_that_is_no_library_is_a_reason(
    choose: Choose, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "libregressor.so").write_text("no library")
    monkeypatch.setattr(compiled, "SOURCE", tmp_path / "kernel.c")
    assert choose("").library is None
