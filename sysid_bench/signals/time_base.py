"""Time base of a log: stamps in seconds, the rate of the grid, and findings about both."""

from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_keys import Time
from sysid_bench.signals.log_source import merge_sources, table_of
from sysid_bench.signals.log_times import check_times, read_times
from sysid_bench.types import Array

LONGEST_GAP: Final = 0.2
"""Share of samples without numbers that is reported and bridged; beyond it the file is not what
its description says."""

SLOWEST: Final = 0.5
"""s between samples; of slower ones no acceleration can be found."""

FASTEST: Final = 1e-9
"""s between samples; stamps that step by less are not in the stated unit."""

SHORTEST: Final = 20
"""Samples; fewer cannot be filtered, differentiated or identified."""

_WIDEST: Final = 3.0
"""Ratio of a recording's length to its samples beyond which it is more gap than recording."""


def read_time(log: LogDescription, samples: int) -> Array | None:
    """Return the time stamps (N,) of the chosen samples in s, as they stand in the file; None
    without a time column.

    Raises UsageError for a wrong unit, column or length.
    """
    stamps = _all_times(log, log.time)
    if stamps is None:
        return None
    # The line that broke off may hold a stamp already; chosen rows end before the file does.
    whole = log.rows is None and log.share == 1.0
    first, spare = (0 if log.rows is None else log.rows[0] - 1), (1 if whole else len(stamps))
    if not samples <= len(stamps) - first <= samples + spare:
        raise UsageError(
            f"{log.source}: there are {len(stamps)} time stamps for {samples} samples."
        )
    return stamps[first : first + samples]


def _all_times(log: LogDescription, time: Time | None) -> Array | None:
    """Return the stamps of the whole file in s."""
    if log.sources and (time is None or time.file is None):
        return merge_sources(log).t
    return None if time is None else read_times(log, time, table_of(log, time))


def time_base(
    log: LogDescription, stamps: Array | None, invalid: Array
) -> tuple[Array, float, list[Finding]]:
    """Return times (N,), NaN where a sample has none, the rate (Hz) of the grid, and findings.

    Without stamps the samples are taken to be evenly spaced. Raises UsageError where fewer than
    SHORTEST stamps rise, these step by less than FASTEST, or span far more than the samples.
    """
    if stamps is None:
        assert log.rate is not None
        return np.arange(len(invalid)) / log.rate, log.rate, []
    t, found = check_times(np.where(invalid, np.nan, stamps))
    steps = np.diff(t[np.isfinite(t)])
    if len(steps) < SHORTEST:
        raise UsageError(
            f"{log.source}: only {len(steps) + 1} time stamps rise; is this the time column?"
        )
    step = float(np.median(steps))  # the median ignores gaps and jitter
    if step < FASTEST:
        raise UsageError(
            f"{log.source}: the time stamps step by {step:.4g} s, which no recorder does; write "
            "the unit of time, as time = { column = ..., unit = 's' }."
        )
    rate, wrong_rate = _grid_rate(log.rate, step, len(t))
    _check_gaps(log, steps, rate, len(t))
    return t, rate, [*found, *_missing(steps, step), *wrong_rate, *_wrong_unit(log, step, len(t))]


def _wrong_unit(log: LogDescription, step: float, samples: int) -> list[Finding]:
    """Return a finding of stamps too far apart for a motion, where no rate contradicts them."""
    if log.rate is not None or step < SLOWEST:
        return []
    text = (
        f"the time stamps step by {step:.4g} s: write the unit of time, as time = {{ column = ..., "
        "unit = 'ms' }"
    )
    return [Finding("time", samples, text, contradiction=True)]


def _missing(steps: Array, step: float) -> list[Finding]:
    """Return a finding of the samples that would have fitted into longer steps."""
    lost = int(np.maximum(np.round(steps / step) - 1, 0).sum())
    longest = f"the longest gap is {steps.max():.4g} s"
    text = f"samples missing between the time stamps: {lost}; {longest}"
    return [Finding("lost", lost, text)] if lost else []


def _grid_rate(declared: float | None, step: float, samples: int) -> tuple[float, list[Finding]]:
    """Return the declared rate (Hz) where the stamps agree with it, else theirs and a finding."""
    rate = declared or 1.0 / step
    # Stamps in ms read as s are off by 1000; real clocks and rounded stamps by a few per cent.
    if abs(rate * step - 1) <= 0.05:
        return rate, []
    text = (
        f"a rate of {rate:.6g} Hz is declared, but the time stamps are {step:.4g} s apart "
        f"({1 / step:.4g} Hz): check the unit of time, or the rate"
    )
    return 1.0 / step, [Finding("rate", samples, text, contradiction=True)]


def _check_gaps(log: LogDescription, steps: Array, rate: float, samples: int) -> None:
    """Raise UsageError where most of the grid would be interpolated over gaps."""
    if np.nansum(steps) * rate > _WIDEST * samples:
        raise UsageError(
            f"{log.source}: the time stamps leave a gap of {steps.max():.4g} s in {samples} "
            f"samples {np.median(steps):.4g} s apart; choose the part that was recorded without "
            "a break (rows = [first, last])."
        )
