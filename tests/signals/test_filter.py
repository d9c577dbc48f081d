"""Laws of the filters: those of SciPy and of means, and texts that are read or refused."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from sysid_bench.errors import UsageError
from sysid_bench.signals.filter import Butterworth, Filter, MovingAverage, NoFilter, filter_of
from sysid_bench.types import Array
from tests.closeness import assert_close

RATE = 200.0


def by_hand(x: Array, window: int) -> Array:
    half = window // 2
    return np.array(
        [x[max(0, k - half) : k + half + 1].mean(axis=0) for k in range(len(x))]
    ).reshape(x.shape)


@pytest.mark.parametrize("window", [1, 3, 21])
def test_the_moving_average_is_the_mean_of_what_there_is(window: int) -> None:
    x = np.random.default_rng(0).normal(size=(50, 2))
    assert_close(MovingAverage(window).smooth(x, RATE), by_hand(x, window))


FILTERS: tuple[Filter, ...] = (NoFilter(), Butterworth(4, 20.0), MovingAverage(21))


@pytest.mark.parametrize("filter", FILTERS, ids=str)
def test_constants_pass_and_filters_are_linear(filter: Filter) -> None:
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, 400, 3))
    np.testing.assert_allclose(filter.smooth(np.full((400, 1), 3.7), RATE), 3.7, atol=1e-9)
    both = filter.smooth(2.0 * x - y, RATE)
    assert_close(both, 2.0 * filter.smooth(x, RATE) - filter.smooth(y, RATE))


@pytest.mark.parametrize("filter", FILTERS, ids=str)
def test_what_is_cut_at_the_edges_is_what_the_start_spoils(filter: Filter) -> None:
    """A disturbance before the first sample moves nothing beyond the edge by more than a little."""
    smooth: Callable[[Array, float], Array] = filter.smooth
    t = np.arange(800) / RATE
    wave = np.sin(2 * np.pi * 2.0 * t)[:, None]
    whole, part = smooth(wave, RATE), smooth(wave[300:], RATE)
    inside = slice(filter.edge(RATE), -filter.edge(RATE) or None)
    assert np.abs(part - whole[300:])[inside][: len(part) // 2].max() < 0.02


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("none", NoFilter()),
        ("butter 4 20 Hz zero-phase", Butterworth(4, 20.0)),
        ("butter 2 0.5 kHz", Butterworth(2, 500.0)),
        ("butter 2 15", Butterworth(2, 15.0)),
        ("average 21", MovingAverage(21)),
    ],
)
def test_filters_as_suites_write_them(text: str, expected: Filter) -> None:
    assert filter_of(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        *("", "zero-phase", "None", "butter", "butter 4", "butter 0 20 Hz", "butter -2 20 Hz"),
        *("butter ² 20 Hz", "butter 4 0 Hz", "butter 4 -20 Hz", "butter 4 20 rad"),
        *("butter 4 twenty Hz", "average", "average 20", "average 0", "average ³", "average 3 s"),
    ],
)
def test_junk_is_refused_in_words(text: str) -> None:
    with pytest.raises(UsageError):
        filter_of(text)


@given(st.text() | st.text("butteravg 0123456789.Hz-", max_size=24))
@settings(max_examples=150)
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        read = filter_of(text)
    except UsageError:
        return
    assert read.edge(RATE) >= 0


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("cutoff", [0.002, 0.05, 0.25, 0.45])
def test_butterworth_is_that_of_scipy(order: int, cutoff: float) -> None:
    """Sections and starts are the same, to rounding; blocks of the recursion leave no trace."""
    x = np.random.default_rng(order).normal(size=(9001, 2)).cumsum(axis=0)
    low_pass = Butterworth(order, cutoff * RATE)
    pad = 3 * low_pass.edge(RATE)
    expected = sosfiltfilt(butter(order, cutoff, fs=1, output="sos"), x, axis=0, padlen=pad)
    assert np.abs(low_pass.smooth(x, RATE) - expected).max() < 1e-9 * np.abs(x).max()
