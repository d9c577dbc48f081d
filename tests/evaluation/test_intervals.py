"""Laws of the methods that make intervals, and of the level that they share."""

import re

import numpy as np
import pytest

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.intervals import (
    LEVEL,
    REPEATS,
    ROBOTS,
    Bootstrap,
    at_level,
    confidence_level,
    coverage_factor,
    jackknife,
    jackknife_std,
    level_text,
    likelihood_drop,
    median_interval,
    new_value_interval,
    percentile_interval,
    share_interval,
    tails,
    with_level,
)
from sysid_bench.metrics import METRICS


def test_jackknife_of_a_mean_is_its_textbook_covariance() -> None:
    values = np.random.default_rng(0).normal(size=(9, 3))
    means = np.array([np.delete(values, k, axis=0).mean(axis=0) for k in range(9)])
    error = jackknife(means, values.mean(axis=0))
    np.testing.assert_allclose(error.covariance, np.cov(values.T) / 9)
    assert error.freedom == 8


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.99])
def test_tails_hold_the_level_and_are_alike(level: float) -> None:
    low, high = tails(level)
    assert (high - low, low) == pytest.approx((level, 1 - high))
    assert coverage_factor(np.inf, level) < coverage_factor(3, level)


def test_range_of_a_new_value_holds_it_at_the_level() -> None:
    values = np.random.default_rng(1).normal(size=(6, 20_000))
    low, high = new_value_interval(values[:5])
    held = ((low <= values[5]) & (values[5] <= high)).mean()
    # Four standard deviations of a share of 20,000.
    assert held == pytest.approx(LEVEL, abs=4 * np.sqrt(LEVEL * (1 - LEVEL) / 20_000))


@pytest.mark.parametrize("bootstrap", [ROBOTS, REPEATS])
def test_every_draw_has_as_many_units_as_there_are(bootstrap: Bootstrap) -> None:
    indices, counts = bootstrap.indices(7), bootstrap.counts(7)
    assert indices.shape == counts.shape == (bootstrap.draws, 7)
    assert set(indices.ravel()) == set(range(7))
    assert (counts.sum(axis=1) == 7).all()
    low, high = percentile_interval(indices.mean(axis=1))
    assert low < 3 < high


def test_share_of_all_or_none_has_one_open_end() -> None:
    assert share_interval(0, 10)[0] == 0.0
    assert share_interval(10, 10)[1] == 1.0
    assert share_interval(0, 10)[1] == pytest.approx(1 - 0.025**0.1)


def test_metrics_of_intervals_name_the_level_that_is_used() -> None:
    named = [metric.title for metric in METRICS.values() if re.search(r"\d+ %", metric.title)]
    assert named
    assert all(level_text() in title for title in named)


def test_every_method_follows_the_level_that_is_stated() -> None:
    values = np.random.default_rng(2).normal(size=(30, 2))

    def lengths() -> list[float]:
        ends = (
            new_value_interval(values[:, 0]),
            median_interval(values[:, 0]),
            share_interval(3, 10),
            jackknife(values, values.mean(axis=0)).interval(values.mean(axis=0)),
        )
        spread = [float(np.ptp(np.array(pair), axis=0).max()) for pair in ends if pair]
        return [*spread, likelihood_drop()]

    usual = lengths()
    with at_level(0.5):
        assert (confidence_level(), level_text()) == (0.5, "50 %")
        assert with_level("its 95 % interval") == "its 50 % interval"
        assert all(np.array(lengths()) < usual)
        with at_level(0.9):  # the outer one is that of the command line
            assert confidence_level() == 0.5
    assert lengths() == usual
    assert (round(coverage_factor(np.inf), 2), likelihood_drop()) == (1.96, 3.84)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, 95.0])
def test_a_level_lies_between_zero_and_one(level: float) -> None:
    with pytest.raises(UsageError, match="between 0 and 1"), at_level(level):
        pass


def test_jackknife_deviations_are_those_of_its_covariance() -> None:
    values = np.random.default_rng(3).normal(size=(8, 4))
    std, freedom = jackknife_std(values)
    error = jackknife(values, values.mean(axis=0))
    np.testing.assert_allclose(std, error.std)
    assert freedom == error.freedom
