"""Laws of the methods that make intervals, and of the level that they share."""

import re

import numpy as np
import pytest

from sysid_bench.evaluation.intervals import (
    LEVEL,
    LEVEL_TEXT,
    REPEATS,
    ROBOTS,
    Bootstrap,
    coverage_factor,
    jackknife,
    new_value_interval,
    percentile_interval,
    share_interval,
    tails,
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
    assert coverage_factor(level, np.inf) < coverage_factor(level, 3)


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
    assert all(LEVEL_TEXT in title for title in named)
