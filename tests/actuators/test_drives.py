"""Actuators of simulated robots with known truth: values, delay, confounding, ranges, models."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from sysid_bench.apps.actuators.bounded_fit import (
    SIGNED,
    Group,
    bounded_fit,
    group_joints,
    independent_samples,
    solve_bounded,
)
from sysid_bench.apps.actuators.delay_profile import delay_grid, delay_profile
from sysid_bench.apps.actuators.drive_estimate import (
    DriveEstimate,
    identify_drives,
)
from sysid_bench.apps.actuators.drive_rows import drive_rows, pooled_rows
from sysid_bench.errors import UsageError
from sysid_bench.signals.log import Log
from sysid_bench.types import Array
from tests.actuators.leg import JOINTS, Case, leg
from tests.closeness import assert_close

ONE_GAIN = ((1.0, 1.0),)
SEEDS = [*range(2), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 8))]


@cache
def log_of_case(case: Case) -> Log:
    """The recording of a case."""
    return case.log()


def identified(case: Case, delay: float | None = None) -> DriveEstimate:
    """The actuators of a case."""
    return identify_drives(drive_rows(leg(), log_of_case(case), JOINTS), delay=delay)


def two_gains(seed: int) -> Case:
    """A recording of chirps and steps under two sets of gains."""
    return Case(seed, delay=0.001 * (3 * seed % 13))


def slow_sweeps(seed: int) -> Case:
    """A recording of slow motions under one set of gains."""
    return replace(two_gains(seed), gains=ONE_GAIN, smooth=True)


@pytest.mark.parametrize("seed", SEEDS)
def test_two_gains_separate_delay_and_armature(seed: int) -> None:
    case = two_gains(seed)
    found = identified(case)
    assert found.delay == pytest.approx(case.delay, abs=1e-3)
    armature, true = found.fit.values[:, 0], case.values[:, 0]
    assert np.median(np.abs(armature / true - 1.0)) < 0.05
    assert found.separation is not None
    assert not found.separation.is_open


@pytest.mark.parametrize("seed", SEEDS)
def test_slow_motions_under_one_set_of_gains_confound_delay_and_armature(seed: int) -> None:
    found = identified(slow_sweeps(seed))
    assert found.separation is not None
    assert found.separation.is_open
    # A longer delay takes the place of armature and damping.
    assert (found.separation.direction[:, :2] < 0.0).all()


def inside(found: DriveEstimate, true: Array) -> Array:
    """Which values their 95 % intervals hold."""
    return np.asarray(np.abs(found.fit.values - true) <= 1.96 * found.std)


def test_intervals_hold_the_truth() -> None:
    cases = [two_gains(seed) for seed in range(4)]
    held = [inside(identified(case, case.delay), case.values) for case in cases]
    assert np.mean(held) >= 0.85


def test_springs_of_the_model_are_known() -> None:
    case = replace(two_gains(1), joint='stiffness="6" springref="20" ')
    robot = leg(case.joint)
    found = identify_drives(drive_rows(robot, case.log(), JOINTS), delay=case.delay)
    values, true = found.fit.values[2], case.values[2]
    np.testing.assert_allclose(values[:SIGNED], true[:SIGNED], rtol=0.15)
    assert values[SIGNED] == pytest.approx(true[SIGNED], abs=0.03)
    without = identify_drives(drive_rows(leg(), case.log(), JOINTS), delay=case.delay)
    assert abs(without.fit.values[2, 3] - case.values[2, 3]) > 0.5  # N m, the spring's torque


def held_share(cases: Sequence[Case]) -> float:
    """Share of the values off their bound that the intervals hold where the delay is unknown."""
    found = [identified(case) for case in cases]
    held = [
        inside(one, case.values)[~one.fit.at_bound] for one, case in zip(found, cases, strict=True)
    ]
    assert all(np.isnan(one.std[one.fit.at_bound]).all() for one in found)
    return float(np.mean(np.concatenate(held)))


def disturbed(seed: int) -> Case:
    """A recording under two sets of gains, with a disturbance as large as the friction."""
    return replace(two_gains(seed), disturbance=0.4)


@pytest.mark.parametrize("kind", [two_gains, slow_sweeps])
def test_intervals_hold_the_truth_where_the_delay_is_unknown(kind: Callable[[int], Case]) -> None:
    assert held_share([kind(seed) for seed in range(2)]) >= 0.85


@pytest.mark.parametrize(
    ("seed", "delay"),
    [
        (9, 0.001),
        *(pytest.param(n, 0.0004 + 0.0012 * n, marks=pytest.mark.long) for n in range(10)),
    ],
)
def test_undisturbed_data_give_the_delay_between_the_samples(seed: int, delay: float) -> None:
    case = replace(two_gains(seed), delay=delay, disturbance=0.0, noise=0.0)
    found = identified(case)
    # Delays of the plant are whole steps of 1 ms.
    assert found.delay == pytest.approx(round(delay, 3), abs=2e-4)
    np.testing.assert_allclose(found.fit.values[:, 0], case.values[:, 0], rtol=0.04)


@pytest.mark.long
@pytest.mark.parametrize("kind", [two_gains, slow_sweeps, disturbed])
def test_95_percent_intervals_hold_90_percent_where_the_delay_is_unknown(
    kind: Callable[[int], Case],
) -> None:
    assert held_share([kind(seed) for seed in range(200, 210)]) >= 0.90


@pytest.mark.long
def test_95_percent_intervals_hold_90_to_98_percent() -> None:
    cases = [two_gains(seed) for seed in range(100, 140)]
    held = np.mean([inside(identified(case, case.delay), case.values) for case in cases])
    assert 0.90 <= held <= 0.98


def test_a_wrong_delay_lowers_armature_and_damping_as_the_direction_says() -> None:
    case = slow_sweeps(1)
    rows = drive_rows(leg(), log_of_case(case), JOINTS)
    groups = group_joints(rows, ())
    near, far = (bounded_fit(groups, rows.torque(d), rows.rate).values for d in (case.delay, 0.0))
    apart = identified(case).separation
    assert apart is not None
    moved = (far - near)[:, 0] / -case.delay
    free = near[:, 0] > 0.0
    np.testing.assert_allclose(moved[free], apart.direction[free, 0], rtol=0.3)


def test_bounded_solutions_are_those_of_an_independent_solver() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        A = rng.normal(size=(40, SIGNED + 2))
        b = A @ rng.normal(size=SIGNED + 2) + 0.1 * rng.normal(size=40)
        low = np.array([0.0] * SIGNED + [-np.inf] * 2)
        expected = lsq_linear(A, b, bounds=(low, np.inf), method="bvls").x
        x, free = solve_bounded(A, b)
        np.testing.assert_allclose(x, expected, atol=1e-8)
        assert set(np.flatnonzero(x[:SIGNED])) == {i for i in free if i < SIGNED}


def test_slow_motions_of_small_rates_are_solved_without_loss() -> None:
    rng = np.random.default_rng(4)
    A = np.column_stack([1e-5 * rng.normal(size=400), np.ones(400)])
    A = np.column_stack([A[:, 0], A[:, 0] + 1e-9 * rng.normal(size=400), rng.normal(size=400),
                         A[:, 1]])  # fmt: skip
    x = np.array([0.4, 0.3, 0.2, -0.1])
    groups = (Group((0,), A),)
    fit = bounded_fit(groups, (A @ x)[:, None], 200.0)
    assert_close(fit.values[0], x, 1e-5)


def test_values_that_would_be_negative_are_on_their_bound() -> None:
    case = slow_sweeps(0)
    rows = drive_rows(leg(), log_of_case(case), JOINTS)
    fit = identify_drives(rows, delay=0.02).fit
    assert fit.at_bound.any()
    assert rows.low is not None
    least = np.hstack([rows.low, np.zeros((len(JOINTS), 1))])
    assert (fit.values[fit.at_bound] <= least[fit.at_bound] * (1.0 + 1e-9)).all()
    assert (fit.values[:, :SIGNED] >= 0.0).all()


def test_joints_of_one_word_share_their_values_but_the_offset() -> None:
    rows = drive_rows(leg(), log_of_case(two_gains(0)), JOINTS)
    fit = identify_drives(rows, ("h",), delay=0.0).fit  # hip and thigh
    np.testing.assert_array_equal(fit.values[0, :SIGNED], fit.values[1, :SIGNED])
    assert fit.values[0, SIGNED] != fit.values[1, SIGNED]
    assert fit.values[2, 0] != fit.values[0, 0]


def test_recordings_together_are_fitted_as_their_rows_together() -> None:
    parts = [drive_rows(leg(), log_of_case(two_gains(0)), JOINTS, s) for s in halves()]
    whole = pooled_rows(parts)
    for delay in (0.0, 0.004):
        np.testing.assert_array_equal(
            whole.torque(delay), np.concatenate([part.torque(delay) for part in parts])
        )
    assert identify_drives(whole).fit.residuals.shape == (len(whole.features), len(JOINTS))


def test_recordings_of_unequal_rates_are_refused() -> None:
    rows = drive_rows(leg(), log_of_case(two_gains(0)), JOINTS)
    pooled_rows([rows, replace(rows, rate=1.0001 * rows.rate)])
    with pytest.raises(UsageError, match="rates of 200, 400 Hz"):
        pooled_rows([rows, replace(rows, rate=2.0 * rows.rate)])


def halves() -> tuple[slice, slice]:
    """Two halves of a recording."""
    count = len(log_of_case(two_gains(0)).recording)
    return slice(0, count // 2), slice(count // 2, count)


def test_the_profile_has_its_minimum_within_its_interval() -> None:
    rows = drive_rows(leg(), log_of_case(two_gains(2)), JOINTS)
    profile = delay_profile(rows, group_joints(rows, ()), delay_grid(rows.rate))
    low, high = profile.interval
    assert low <= profile.best <= high
    assert profile.loss.min() >= -1e-9
    assert not profile.on_edge
    on_grid = delay_profile(rows, group_joints(rows, ()), delay_grid(rows.rate), between=False)
    assert on_grid.best in on_grid.delays


@pytest.mark.parametrize("rate", [5.0, 20.0, 30.0, 60.0, 200.0, 1000.0])
def test_delays_of_two_samples_and_of_20_ms_are_tried_at_any_rate(rate: float) -> None:
    grid = delay_grid(rate)
    assert len(grid) >= 5
    assert grid[0] == 0.0
    assert grid[-1] >= max(0.02, 2.0 / rate) - 0.5 / rate
    np.testing.assert_allclose(np.diff(grid), 0.5 / rate)
    assert grid[-1] * rate >= 2.0 - 1e-9


def test_correlated_residuals_count_as_fewer() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=(4000, 1))
    slow = np.convolve(white[:, 0], np.ones(10) / 10.0)[:4000, None]
    assert independent_samples(white, 200.0)[0] > 2000
    assert independent_samples(slow, 200.0)[0] == pytest.approx(400, rel=0.4)
    assert independent_samples(white, 1.0)[0] == 4000  # half a second holds no lag
