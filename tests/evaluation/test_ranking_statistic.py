"""Statistics of rankings against brute force, their definitions and simulation."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import rankdata, wilcoxon

from sysid_bench.evaluation.intervals import ROBOTS, median_interval, percentile_interval
from sysid_bench.evaluation.robot_statistic import (
    RatioFigure,
    holm,
    least_p,
    mean_by_robot,
    rank_interval,
    rank_test_p,
    ratio_profile,
    verdict,
    win_rates,
)
from sysid_bench.types import Array


def enumerated_p(values: Array) -> float:
    """p from all signs of the ranks, one by one."""
    values = values[values != 0]
    ranks = rankdata(np.abs(values))
    sums = np.array([ranks @ signs for signs in product((0, 1), repeat=len(values))])
    seen = ranks @ (values > 0)
    return float(min(1.0, 2 * min((sums <= seen).mean(), (sums >= seen).mean())))


@pytest.mark.parametrize("seed", range(8))
def test_p_is_that_of_all_signs_with_ties_and_zeros(seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = rng.integers(-3, 5, size=rng.integers(1, 11)).astype(float)
    if whole.any():
        assert rank_test_p(whole) == pytest.approx(enumerated_p(whole), abs=1e-14)
    assert rank_test_p(np.concatenate([whole, -whole])) == 1.0  # twice a half and more is all
    smooth = rng.normal(0.3, 1.0, size=5 + 4 * seed)
    assert rank_test_p(smooth) == pytest.approx(wilcoxon(smooth, method="exact").pvalue, rel=1e-12)


@pytest.mark.parametrize("robots", range(1, 20))
def test_no_data_of_so_many_robots_have_a_smaller_p(robots: int) -> None:
    rng = np.random.default_rng(robots)
    assert rank_test_p(rng.uniform(0.1, 9.0, robots)) == pytest.approx(least_p(robots))
    assert rank_test_p(rng.normal(size=robots)) >= least_p(robots) - 1e-15
    assert rank_test_p(np.zeros(robots)) == least_p(0) == 1.0


@pytest.mark.parametrize("seed", range(8))
def test_robots_without_a_difference_are_no_part_of_the_smallest_p(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.uniform(0.1, 9.0, 12) * (rng.random(12) < 0.6)
    assert rank_test_p(values) == pytest.approx(least_p(int(np.count_nonzero(values))))
    assert (rank_test_p(values) > least_p(12)) == bool((values == 0).any())


@pytest.mark.parametrize("seed", range(6))
def test_each_robot_has_the_mean_of_its_values(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robots = [f"robot{rng.integers(9)}" for _ in range(60)]
    values = np.where(rng.random(60) < 0.3, np.nan, rng.normal(size=60))
    names = [*dict.fromkeys(robots), "absent"]
    found = mean_by_robot(robots, values, names)
    for name, mean in zip(names, found, strict=True):
        own = [x for x, robot in zip(values, robots, strict=True) if robot == name and x == x]
        assert mean == pytest.approx(sum(own) / len(own)) if own else np.isnan(mean)
    order = rng.permutation(60)
    shuffled = mean_by_robot([robots[i] for i in order], values[order], names)
    np.testing.assert_allclose(shuffled, found, rtol=1e-12)


@pytest.mark.parametrize("robots", [0, 1, ROBOTS.fewest - 1, ROBOTS.fewest, 15])
def test_the_figure_of_log_ratios_is_their_median(robots: int) -> None:
    logs = np.random.default_rng(robots).normal(size=robots)
    figure = RatioFigure.of(logs)
    assert (figure.value is None) == (robots == 0)
    if robots:
        assert figure.value == pytest.approx(np.exp(np.median(logs)))
    ends = median_interval(logs)
    expected = (None, None) if ends is None else pytest.approx(tuple(np.exp(ends)))
    assert (figure.low, figure.high) == expected


def test_holm_is_the_textbook_example() -> None:
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])


def test_intervals_hold_the_median_of_all_robots() -> None:
    rng = np.random.default_rng(3)
    ends = [median_interval(rng.normal(size=15)) for _ in range(100)]
    held = np.mean([low <= 0.0 <= high for low, high in filter(None, ends)])
    assert len(ends) == 100
    assert 0.87 <= held <= 1.0


def test_few_robots_have_no_interval() -> None:
    for robots in range(ROBOTS.fewest + 2):
        assert (median_interval(np.arange(float(robots))) is None) == (robots < ROBOTS.fewest)
    assert ROBOTS.indices(9).shape == (ROBOTS.draws, 9)
    np.testing.assert_array_equal(ROBOTS.indices(9), replace(ROBOTS).indices(9))


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [
        (0.80, 0.90, "better"),
        (0.80, 0.99, "better"),
        (0.80, 1.01, "undecided"),
        (0.92, 0.99, "equivalent"),
        (0.92, 1.09, "equivalent"),
        (0.92, 1.11, "undecided"),
        (1.01, 1.09, "equivalent"),
        (1.01, 1.11, "worse"),
    ],
)
def test_a_verdict_follows_the_interval_and_the_margin(low: float, high: float, found: str) -> None:
    assert verdict(np.log(low), np.log(high), 0.1) == found


@given(st.floats(0.01, 1.0), st.tuples(*[st.sampled_from([0, -1, 1]) | st.floats(-3, 3)] * 2))
def test_ends_at_zero_and_at_the_margin_decide_for_both_sides(
    margin: float, ends: tuple[float, float]
) -> None:
    """An interval that ends at zero excludes nothing; one that ends at the margin is within it."""
    limit = float(np.log1p(margin))
    low, high = sorted(limit * end for end in ends)
    found = verdict(low, high, margin)
    assert (found == "equivalent") == (max(-low, high) <= limit)
    if found != "equivalent":
        sides = {"better": high < 0, "worse": low > 0, "undecided": low <= 0 <= high}
        assert sides[found]
    swapped = {"better": "worse", "worse": "better"}
    assert verdict(-high, -low, margin) == swapped.get(found, found)


def test_wins_count_failures_as_lost_and_leave_absent_rows_out() -> None:
    inf, nan = np.inf, np.nan
    values = np.array([[1.0, 2.0, inf], [1.0, 1.0, nan], [3.0, 1.5, inf], [inf, inf, inf]])
    wins = win_rates(values)
    np.testing.assert_allclose(wins + wins.T, 1.0)
    assert wins[0, 1] == pytest.approx((1 + 0.5 + 0 + 0.5) / 4)
    assert wins[0, 2] == pytest.approx((1 + 1 + 0.5) / 3)
    assert np.isnan(win_rates(np.array([[1.0, nan], [nan, 1.0]]))[0, 1])


def test_a_profile_counts_a_failure_as_within_nothing() -> None:
    profile = ratio_profile(np.array([0.5, 1.0, 2.0, np.nan]), np.array([0.4, 1.0, 10.0]))
    np.testing.assert_allclose(profile, [0.0, 0.5, 0.75])


@pytest.mark.parametrize("count", [1, 2, 7])
def test_a_profile_is_the_share_up_to_each_limit(count: int) -> None:
    """The limit itself belongs to it, of one case as of many."""
    ratios = np.random.default_rng(count).uniform(0.5, 5.0, count)
    found = ratio_profile(ratios, np.sort(ratios))
    np.testing.assert_allclose(found, np.arange(1, count + 1) / count)
    assert ratio_profile(ratios, np.array([np.nextafter(ratios.min(), 0.0)])) == [0.0]
    np.testing.assert_array_equal(ratio_profile(ratios[:0], np.array([1.0, 9.0])), [0.0, 0.0])


@pytest.mark.parametrize("seed", range(6))
def test_ranks_are_those_of_the_medians_and_ties_share_the_lowest(seed: int) -> None:
    """Where a method has no robot in some draws, too; intervals from just six robots on."""
    rng = np.random.default_rng(seed)
    logs = np.round(rng.normal(size=(ROBOTS.fewest + seed, 5)), 1)
    rank, low, high = rank_interval(logs)
    np.testing.assert_array_equal(rank, rankdata(np.median(logs, axis=0), method="min"))
    assert np.isfinite(low).all()
    draws = np.median(logs[ROBOTS.indices(len(logs))], axis=1)
    drawn = np.apply_along_axis(rankdata, 1, draws, method="min")
    np.testing.assert_allclose((low, high), percentile_interval(drawn))
    assert np.isnan(rank_interval(logs[: ROBOTS.fewest - 1])[1:]).all()


@pytest.mark.parametrize("seed", range(6))
def test_corrected_p_are_those_of_holms_procedure(seed: int) -> None:
    """Hypotheses are rejected one by one, from the smallest p on, until one is not."""
    rng = np.random.default_rng(seed)
    p = np.round(rng.uniform(0, 0.3, size=rng.integers(1, 7)), 2)
    found = holm(p)
    for level in (0.01, 0.05, 0.2, 0.6):
        rejected = np.zeros(len(p), dtype=bool)
        for left, place in zip(range(len(p), 0, -1), np.argsort(p, kind="stable"), strict=True):
            if p[place] * left > level + 1e-12:
                break
            rejected[place] = True
        np.testing.assert_array_equal(found <= level + 1e-12, rejected)
    assert found.max() <= 1.0
    assert holm(np.array([0.9, 0.8])).tolist() == [1.0, 1.0]


def test_ranks_are_intervals_that_hold_them() -> None:
    rng = np.random.default_rng(5)
    logs = rng.normal([0.0, 0.05, 2.0], 0.3, size=(12, 3))
    rank, low, high = rank_interval(logs)
    assert (low <= rank).all()
    assert (rank <= high).all()
    assert low[2] == high[2] == 3
    assert (low[0], high[1]) == (1, 2)  # two methods this near may have either rank
    logs[:11, 1] = np.nan  # many draws have no robot of it
    assert np.isfinite(rank_interval(logs)).all()
    assert np.isnan(rank_interval(rng.normal(size=(ROBOTS.fewest - 1, 3)))[1]).all()
