"""Statistics of rankings against brute force, their definitions and simulation."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import rankdata, wilcoxon

from sysid_bench.evaluation.intervals import (
    LEVEL,
    ROBOTS,
    confidence_level,
    median_interval,
    median_ranks,
    percentile_interval,
)
from sysid_bench.evaluation.robot_statistic import (
    RatioFigure,
    equivalence_p,
    holm,
    least_p,
    mean_by_robot,
    rank_interval,
    rank_test_p,
    ratio_profile,
    robots_needed,
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


@pytest.mark.parametrize("robots", range(ROBOTS.fewest, 17))
def test_intervals_hold_the_median_exactly_as_often_as_they_say(robots: int) -> None:
    """By enumeration of the sides of the median that the robots lie on."""
    found = median_ranks(robots)
    assert found is not None
    k, coverage = found
    below = np.array([bin(sides).count("1") for sides in range(2**robots)])
    assert coverage == pytest.approx(np.mean((below >= k) & (robots - below >= k)), abs=1e-12)
    narrower = np.mean((below > k) & (robots - below > k))
    assert narrower < confidence_level() <= coverage
    values = np.random.default_rng(robots).permutation(robots).astype(float)
    assert median_interval(values) == (k - 1.0, robots - k)


@pytest.mark.parametrize("robots", [6, 8, 13])
def test_intervals_hold_the_median_of_skew_populations(robots: int) -> None:
    """Where the percentile bootstrap holds that of 91 %."""
    rng, (_, coverage) = np.random.default_rng(robots), median_ranks(robots) or (0, 0.0)
    ends = [median_interval(row) for row in rng.exponential(size=(4000, robots))]
    held = np.mean([low <= np.log(2.0) <= high for low, high in filter(None, ends)])
    # Four standard deviations of a share of 4,000.
    assert held == pytest.approx(coverage, abs=4 * np.sqrt(coverage * (1 - coverage) / 4000))


def test_intervals_follow_an_increasing_map_and_the_sign() -> None:
    rng = np.random.default_rng(2)
    for robots in (6, 9, 14):
        values = rng.normal(size=robots)
        low, high = median_interval(values) or (0.0, 0.0)
        assert median_interval(np.exp(values)) == pytest.approx((np.exp(low), np.exp(high)))
        assert median_interval(-rng.permutation(values)) == (-high, -low)


def test_few_robots_have_no_interval() -> None:
    for robots in range(ROBOTS.fewest + 2):
        assert (median_interval(np.arange(float(robots))) is None) == (robots < ROBOTS.fewest)
    assert ROBOTS.indices(9).shape == (ROBOTS.draws, 9)
    np.testing.assert_array_equal(ROBOTS.indices(9), replace(ROBOTS).indices(9))


@pytest.mark.parametrize("seed", range(20))
def test_equivalence_is_an_interval_within_the_margin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(rng.normal(0, 0.05), 0.08, rng.integers(ROBOTS.fewest, 20))
    if seed % 2:  # on the margin itself
        values[: seed % 5] = rng.choice([-1, 1]) * np.log1p(0.1)
    low, high = median_interval(values) or (-np.inf, np.inf)
    within = max(-low, high) <= np.log1p(0.1)
    assert (equivalence_p(values, 0.1) <= 1 - LEVEL) == within
    assert equivalence_p(-values, 0.1) == equivalence_p(values, 0.1)
    assert equivalence_p(values, 0.2) <= equivalence_p(values, 0.1)
    assert least_p(len(values)) <= equivalence_p(values, 0.1) <= 1.0
    assert equivalence_p(np.zeros(len(values)), 0.1) == least_p(len(values))


WORDS = ("better", "worse", "equivalent", "undecided")


@given(st.integers(0, 300), st.floats(0, 1), st.floats(0, 1))
def test_verdicts_are_monotone_and_have_two_sides(seed: int, p: float, equal: float) -> None:
    rng = np.random.default_rng(seed)
    logs = rng.normal(rng.normal(0, 0.2), rng.choice([0.01, 0.1, 0.5]), rng.integers(3, 16))
    found = verdict(logs, 0.1, p, equal)
    assert found in WORDS
    swapped = {"better": "worse", "worse": "better"}
    assert verdict(-logs, 0.1, p, equal) == swapped.get(found, found)
    # A larger p decides nothing that a smaller one left open.
    assert verdict(logs, 0.1, min(1.0, 2 * p), min(1.0, 2 * equal)) in (found, "undecided")
    assert verdict(logs, 0.1, 1.0, 1.0) == verdict(logs[:5], 0.1, 0.0, 0.0) == "undecided"
    if found in ("better", "worse"):
        low, high = median_interval(logs) or (0.0, 0.0)
        assert p <= 1 - LEVEL < equal
        assert low > 0 or high < 0
        assert abs(np.median(logs)) > np.log(1.1)


@pytest.mark.parametrize("centre", [0.0, float(np.log1p(0.1))])
def test_one_in_twenty_pages_has_a_false_verdict_at_most(centre: float) -> None:
    """Of methods without a difference none is better or worse; on the margin, none equivalent."""
    rng, false = np.random.default_rng(7), 0
    for _ in range(150):
        page = rng.normal(centre, 0.05, (6, 12))
        raw = np.array([(rank_test_p(row), equivalence_p(row, 0.1)) for row in page])
        found = {verdict(row, 0.1, *p) for row, p in zip(page, holm(raw).tolist(), strict=True)}
        false += bool(found & ({"better", "worse"} if centre == 0.0 else {"equivalent"}))
    assert false <= 15  # binomial: above 14 of 150 with 0.9 % at 5 %


@pytest.mark.parametrize("seed", range(6))
def test_two_hypotheses_in_a_line_are_corrected_by_closed_testing(seed: int) -> None:
    """Against the definition: the largest Bonferroni p of all sets of hypotheses, at most one of
    each line, that may be true together."""
    p = np.round(np.random.default_rng(seed).uniform(0, 0.2, (3, 2)), 3)
    found, sets = holm(p), list(product((0, 1, None), repeat=3))
    for line, place in product(range(3), (0, 1)):
        true = [one for one in sets if one[line] == place]
        bonferroni = [
            min(p[i, j] for i, j in enumerate(one) if j is not None)
            * sum(j is not None for j in one)
            for one in true
        ]
        assert found[line, place] >= min(1.0, max(bonferroni)) - 1e-12
    np.testing.assert_allclose(holm(p[:, :1])[:, 0], holm(p[:, 0]))
    assert (holm(p) <= holm(np.vstack([p, p]))[:3] + 1e-12).all()  # more verdicts, larger p
    assert holm(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("verdicts", [1, 2, 10, 40, 98, 1000])
def test_so_many_robots_decide_and_one_less_does_not(verdicts: int) -> None:
    needed = robots_needed(verdicts)
    for robots, word in ((needed, "worse"), (needed - 1, "undecided")):
        logs = np.linspace(0.5, 0.6, robots)
        raw = np.array(
            [(rank_test_p(logs), equivalence_p(logs, 0.1)), *[(1.0, 1.0)] * (verdicts - 1)]
        )
        assert verdict(logs, 0.1, *holm(raw)[0]) == word
        raw[0] = rank_test_p(0.0 * logs), equivalence_p(0.0 * logs, 0.1)
        expected = "equivalent" if word == "worse" else word
        assert verdict(0.0 * logs, 0.1, *holm(raw)[0]) == expected


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
