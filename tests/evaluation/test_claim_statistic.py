"""Laws of verdicts: monotone in the threshold, open where an interval straddles it or is absent."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, t

from sysid_bench.evaluation import robot_statistic
from sysid_bench.evaluation.intervals import ROBOTS, left_out_held, percentile_interval
from sysid_bench.evaluation.robot_statistic import (
    ClaimFigure,
    ClaimInterval,
    Direction,
    benjamini_hochberg,
    by_robot,
    claim_p,
    claim_verdict,
    mean_figure,
    median_figure,
    rank_figure,
    ratio_figure,
    share_figure,
    units_needed,
)
from sysid_bench.types import Array

NUMBERS = st.floats(-10, 10)
ORDER = ("fails", "open", "holds")


@st.composite
def figures(draw: st.DrawFn) -> ClaimFigure:
    low, value, high = sorted(draw(st.tuples(NUMBERS, NUMBERS, NUMBERS)))
    return ClaimFigure(value, low, high, draw(st.integers(ROBOTS.fewest, 20)))


@given(figures(), NUMBERS, NUMBERS)
def test_a_looser_limit_makes_no_verdict_worse(figure: ClaimFigure, a: float, b: float) -> None:
    tight, loose = sorted((a, b))
    below = [claim_verdict(figure, ClaimInterval.of("at most", (t,))) for t in (tight, loose)]
    above = [claim_verdict(figure, ClaimInterval.of("at least", (t,))) for t in (loose, tight)]
    for first, second in (below, above):
        assert ORDER.index(first) <= ORDER.index(second)


@given(figures(), NUMBERS)
def test_a_verdict_is_open_where_the_interval_straddles_the_threshold(
    figure: ClaimFigure, limit: float
) -> None:
    assert figure.low is not None
    assert figure.high is not None
    below = claim_verdict(figure, ClaimInterval.of("at most", (limit,)))
    above = claim_verdict(figure, ClaimInterval.of("at least", (limit,)))
    assert (below == "open") == (figure.low <= limit < figure.high)
    assert (above == "open") == (figure.low < limit <= figure.high)
    if figure.low != limit != figure.high:  # what one direction allows, the other forbids
        assert {below, above} in ({"holds", "fails"}, {"open"})


@given(figures(), NUMBERS, st.floats(0, 5))
def test_within_is_both_directions_together(figure: ClaimFigure, low: float, width: float) -> None:
    within = claim_verdict(figure, ClaimInterval.of("within", (low, low + width)))
    sides = [
        claim_verdict(figure, ClaimInterval.of("at least", (low,))),
        claim_verdict(figure, ClaimInterval.of("at most", (low + width,))),
    ]
    assert within == min(sides, key=ORDER.index)


@given(NUMBERS, NUMBERS)
def test_without_an_interval_every_verdict_is_open(value: float, limit: float) -> None:
    for direction in ("at most", "at least"):
        figure = ClaimFigure(value, None, None, ROBOTS.fewest - 1)
        assert claim_verdict(figure, ClaimInterval.of(direction, (limit,))) == "open"


@pytest.mark.parametrize("count", [1, ROBOTS.fewest - 1, ROBOTS.fewest, 30])
@pytest.mark.parametrize("figure_of", [median_figure, mean_figure, ratio_figure])
def test_intervals_hold_the_value_and_need_six_robots(figure_of: object, count: int) -> None:
    assert callable(figure_of)
    found = figure_of(np.random.default_rng(count).normal(0.4, 0.1, count))
    assert found.count == count
    assert (found.low is None) == (found.high is None) == (count < ROBOTS.fewest)
    if found.low is not None:
        assert found.low < found.value < found.high


@pytest.mark.parametrize("count", [1, ROBOTS.fewest - 1, ROBOTS.fewest, 10, 30, 72])
def test_shares_have_the_exact_interval_of_a_binomial(count: int) -> None:
    for hits in {0, 1, count // 2, count - 1, count}:
        found = share_figure(np.repeat([1.0, 0.0], [hits, count - hits]))
        exact = binomtest(hits, count).proportion_ci(0.95, method="exact")
        assert found.value == hits / count
        if count < ROBOTS.fewest:
            assert (found.low, found.high) == (None, None)
        else:
            assert (found.low, found.high) == pytest.approx((exact.low, exact.high), abs=1e-9)
    every = share_figure(np.ones(count))
    assert claim_verdict(every, ClaimInterval.of("at least", (1.0,))) == "open"
    high = ClaimInterval.of("at least", (0.95,))
    assert claim_verdict(every, high) == ("holds" if count >= 72 else "open")


@pytest.mark.parametrize("share", [0.3, 0.7, 0.95])
def test_intervals_of_shares_hold_the_share_of_the_population(share: float) -> None:
    rng = np.random.default_rng(1)
    # Robots that are not alike: each has its own share, drawn around that of the population.
    drawn = rng.beta(4 * share, 4 * (1 - share), (400, 8))
    found = [share_figure(rng.binomial(3, one) / 3) for one in drawn]
    held = [one.low is not None and one.low <= share <= (one.high or 0.0) for one in found]
    assert np.mean(held) >= 0.95


@pytest.mark.parametrize("value", [0.0, 0.4, 1 / 3, 1.0])
def test_coverages_without_spread_decide_nothing(value: float) -> None:
    figure = mean_figure(np.full(9, value))
    assert figure.value == pytest.approx(value)
    assert (figure.low, figure.reason) == (None, "no spread")
    assert claim_verdict(figure, ClaimInterval.of("at least", (-1.0,))) == "open"
    assert mean_figure(np.array([*np.full(8, value), 0.5])).low is not None


@pytest.mark.parametrize("count", [5, 6, 9])
def test_coverages_of_six_robots_with_a_spread_have_the_interval_of_the_bootstrap(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The range up to which they are one number belongs to it: 1e-12, and 1e-11 is a spread."""
    values = np.linspace(0.5, 0.75, count)
    figure = mean_figure(values)
    assert figure.value == pytest.approx(0.625)
    assert figure.count == count
    assert (figure.low is not None) == (count >= 6)
    if figure.low is not None:
        means = np.array([values[draw].mean() for draw in ROBOTS.indices(count)])
        assert (figure.low, figure.high) == pytest.approx(tuple(percentile_interval(means)))
        assert mean_figure(0.5 + np.linspace(0, 1e-11, count)).low is not None
        monkeypatch.setattr(robot_statistic, "SPREAD", 0.25)
        assert mean_figure(values).reason == "no spread"
        monkeypatch.setattr(robot_statistic, "SPREAD", float(np.nextafter(0.25, 0.0)))
        assert mean_figure(values) == figure


@pytest.mark.parametrize("seed", range(4))
def test_p_is_where_the_interval_stops_to_decide(seed: int) -> None:
    """It holds at the usual level where p is below it; a looser threshold has a smaller p."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0.9, 0.2, 8 + seed)
    figures_of: tuple[Callable[[], ClaimFigure], ...] = (
        lambda: median_figure(values),
        lambda: share_figure((values > 0.8) * 1.0),
    )
    for figure in figures_of:
        found = []
        for limit in (0.3, 0.6, 0.9, 1.2):
            threshold = ClaimInterval.of("at most", (limit,))
            p, verdict = claim_p(figure, threshold), claim_verdict(figure(), threshold)
            assert (p <= 0.05) == (verdict != "open")
            found.append(p if verdict == "holds" else 1.0)
        assert found == sorted(found, reverse=True)
    assert claim_p(lambda: median_figure(values[:5]), ClaimInterval.of("at most", (9.0,))) == 1.0
    # Of medians it is that of the sign test.
    above = ClaimInterval.of("at least", (0.0,))
    exact = binomtest(len(values), len(values)).pvalue
    assert claim_p(lambda: median_figure(values + 9), above) == pytest.approx(exact, abs=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_false_discoveries_are_corrected_by_the_step_up_procedure(seed: int) -> None:
    """Those rejected at a level q are the k smallest, k the last with p_(k) <= q k / m."""
    rng = np.random.default_rng(seed)
    p = np.round(rng.uniform(0, 1, rng.integers(1, 12)) ** 2, 3)
    corrected, ordered = benjamini_hochberg(p), np.sort(p)
    for q in (0.01, 0.05, 0.2, 0.5):
        met = np.flatnonzero(ordered <= q * np.arange(1, len(p) + 1) / len(p) + 1e-12)
        limit = ordered[met[-1]] if len(met) else -1.0
        np.testing.assert_array_equal(corrected <= q + 1e-12, p <= limit)
    assert (corrected >= p).all()
    assert benjamini_hochberg(np.zeros(0)).shape == (0,)


def test_units_that_a_claim_needs_let_it_hold_and_one_less_does_not() -> None:
    cases: tuple[tuple[Direction, tuple[float, ...]], ...] = (
        ("at least", (0.5,)),
        ("at least", (0.95,)),
        ("at most", (0.2,)),
        ("within", (0.4, 0.9)),
    )
    for direction, limits in cases:
        threshold = ClaimInterval.of(direction, limits)
        needed = units_needed("share", threshold)
        assert needed is not None

        def can_hold(count: int, threshold: ClaimInterval = threshold) -> bool:
            shares = (share_figure(np.repeat([1.0, 0.0], [k, count - k])) for k in range(count + 1))
            return any(claim_verdict(one, threshold) == "holds" for one in shares)

        assert can_hold(needed)
        assert not can_hold(needed - 1)
    assert units_needed("share", ClaimInterval.of("at least", (1.0,))) is None
    assert units_needed("ratio", ClaimInterval.of("at most", (1.0,))) == ROBOTS.fewest


def test_known_values() -> None:
    logs = np.log([0.5] * 4 + [0.25] * 3)
    ratio = ratio_figure(logs)
    assert ratio.value == pytest.approx(0.5)
    assert ratio.low == pytest.approx(0.25)
    assert ratio.high == pytest.approx(0.5)
    assert mean_figure(np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])).value == pytest.approx(5 / 6)
    table = np.column_stack([np.zeros(8), np.full(8, -1.0), np.full(8, 2.0)])
    ranked = rank_figure(table)
    assert (ranked.value, ranked.low, ranked.high) == (2.0, 2.0, 2.0)
    assert rank_figure(table[:3]).low is None


@pytest.mark.parametrize("seed", range(5))
def test_each_robot_counts_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robots: Array = rng.choice(np.array(["ur5", "panda", "so100", "z1"]), 40)
    values = np.where(rng.random(40) < 0.2, np.nan, rng.normal(size=40))
    expected = [
        np.nanmean(values[robots == robot])
        for robot in np.unique(robots)
        if not np.isnan(values[robots == robot]).all()
    ]
    np.testing.assert_allclose(by_robot(robots, values), expected)
    np.testing.assert_allclose(by_robot(np.repeat(robots, 3), np.repeat(values, 3)), expected)
    assert by_robot(robots, np.full(40, np.nan)).shape == (0,)


@pytest.mark.parametrize(("n", "share"), [(3, 0.9), (6, 0.9), (6, 0.95), (12, 0.8)])
def test_ranges_of_the_others_hold_their_share_of_normal_values(n: int, share: float) -> None:
    values = 3.0 + 0.2 * np.random.default_rng(n).normal(size=(n, 20_000))
    held = left_out_held(values, share)
    assert held.shape == values.shape
    assert held.mean() == pytest.approx(share, abs=0.01)


def test_a_value_far_from_the_others_is_not_held() -> None:
    values = np.array([[1.0], [1.1], [0.9], [1.05], [5.0]])
    assert left_out_held(values, 0.9)[:, 0].tolist() == [1.0, 1.0, 1.0, 1.0, 0.0]
    assert np.isnan(left_out_held(values[:2], 0.9)).all()


@given(st.integers(3, 12), st.sampled_from([0.8, 0.9, 0.95]), st.booleans())
def test_the_range_of_the_others_is_the_textbook_prediction_interval(
    n: int, share: float, above: bool
) -> None:
    """Mean +- t s sqrt(1 + 1 / m) of m = n - 1 others: just inside is held, just outside is not."""
    others = np.random.default_rng(n).normal(size=n - 1)
    m = len(others)
    reach = t.ppf((1 + share) / 2, m - 1) * others.std(ddof=1) * np.sqrt((m + 1) / m)
    for factor, expected in ((1 - 1e-6, 1.0), (1 + 1e-6, 0.0)):
        own = others.mean() + (1 if above else -1) * factor * reach
        held = left_out_held(np.append(others, own)[:, None], share)
        assert held[-1, 0] == expected
