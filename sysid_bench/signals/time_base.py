"""Time base of a log: stamps that rise, without those that leave the line of their neighbours, the
rate of the grid, and findings about both."""

from bisect import bisect_left
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sysid_bench.errors import UsageError
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.types import Array

TOO_MANY: Final = 0.2
"""Share of stamps that leave the line or run backwards beyond which the column is not time."""

_WINDOW: Final = 41
"""Samples around a stamp that predict it; up to half of them may be wrong."""

_BLOCK: Final = 10_000
"""Windows whose medians are taken at once."""

_FAR: Final = 20.0
"""Median steps, and median deviations, from that line beyond which a stamp is wild."""

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

_REGULAR: Final = 0.9
"""Share of the steps, and of the runs of equal stamps, that are alike where stamps are rounded: a
clock that now and then stands still jumps afterwards."""

_RESETS: Final = 3
"""Falling stamps up to which each is a clock that was set back; more are rows out of order."""


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
    before = 0 if log.rows is None else log.rows[0] - 1
    t, found = check_times(np.where(invalid, np.nan, stamps), before)
    kept, N = t[np.isfinite(t)], len(t)
    steps = np.diff(kept)
    if len(steps) < SHORTEST:
        falling = int((np.diff(stamps[np.isfinite(stamps)]) < 0).sum())
        cure = "is this the time column?"
        if 2 * falling > N:
            cure = f"{falling} fall: write the rows in the order of time, or state rate instead."
        raise UsageError(f"{log.source}: only {len(steps) + 1} of {N} time stamps rise; {cure}")
    step = float(np.median(steps))  # the median ignores gaps and jitter
    if step < FASTEST:
        raise UsageError(
            f"{log.source}: the time stamps step by {step:.4g} s, which no recorder does; write "
            "the unit of time, as time = { column = ..., unit = 's' }."
        )
    # Longer steps have room for samples, less the rows in them whose stamps are left out.
    there, _ = np.histogram(stamps[np.isfinite(stamps) & ~np.isin(stamps, kept)], kept)
    lost = int(np.maximum(np.round(steps / step) - 1 - there, 0).sum())
    if lost:
        longest = f"the longest gap is {steps.max():.4g} s"
        text = f"samples missing between the time stamps: {lost}; {longest}"
        found.append(Finding("lost", lost, text))
    rate, of_rate = _grid_rate(log, step, N)
    # Most of the grid would be interpolated over gaps.
    if np.nansum(steps) * rate > _WIDEST * N:
        raise UsageError(
            f"{log.source}: the time stamps leave a gap of {steps.max():.4g} s in {N} samples "
            f"{step:.4g} s apart; choose the part that was recorded without a break (rows = "
            "[first, last])."
        )
    return t, rate, [*found, *of_rate]


def _grid_rate(log: LogDescription, step: float, N: int) -> tuple[float, list[Finding]]:
    """Return the declared rate (Hz) where the stamps agree with it, else theirs; and findings."""
    if log.rate is None and step >= SLOWEST:
        text = (
            f"the time stamps step by {step:.4g} s: write the unit of time, as time = {{ column = "
            "..., unit = 'ms' }"
        )
        return 1.0 / step, [Finding("time", N, text, contradiction=True)]
    rate = log.rate or 1.0 / step
    # Stamps in ms read as s are off by 1000; real clocks and rounded stamps by a few per cent.
    if abs(rate * step - 1) <= 0.05:
        return rate, []
    text = (
        f"a rate of {rate:.6g} Hz is declared, but the time stamps are {step:.4g} s apart "
        f"({1 / step:.4g} Hz): check the unit of time, or the rate"
    )
    return 1.0 / step, [Finding("rate", N, text, contradiction=True)]


def check_times(t: Array, before: int = 0) -> tuple[Array, list[Finding]]:
    """Return stamps (N,) that increase, NaN for the others, and findings of those left out, in the
    row after `before` of the file and those behind it.

    A stamp far from the line of its neighbours is left out first, so that it costs one row; of the
    rest, the longest series that increases is kept.
    """
    wild = _wild(t)
    kept, repeated, backwards = _increasing(np.where(wild, np.nan, t))
    limit = TOO_MANY * len(t)
    found = []
    if count := int(wild.sum()):
        text = f"{count} time stamps leave the line of their neighbours"
        found.append(Finding("time", count, text, count > limit))
    if repeated > limit and (rounded := _rounded(t, repeated)) is not None:
        found.append(rounded)
    elif repeated:
        edit = "rate = that of the recorder, in place of time"
        text = f"{repeated} time stamps are repeated"
        found.append(Finding("time", repeated, text, edit=edit))
    if backwards:
        text = f"{backwards} time stamps run backwards"
        edit = _edit_of_falls(t, before)
        found.append(Finding("time", backwards, text, backwards > limit, edit))
    return kept, found


def _rounded(t: Array, repeated: int) -> Finding | None:
    """Return the contradiction of stamps (N,) that repeat in runs of one length, each a step after
    the run before: rounded ones; None for others."""
    stamps = t[np.isfinite(t)]
    starts = np.flatnonzero(np.diff(stamps, prepend=-np.inf))
    # The first and the last run may be cut.
    runs, steps = np.diff(starts)[1:], np.diff(stamps[starts])
    if len(runs) < SHORTEST:
        return None
    step = float(np.median(steps))
    # Evenly spaced samples fall into runs that differ by one, and leave no cell of rounding empty.
    alike = np.abs(runs - np.mean(runs)) <= 1, np.abs(steps - step) < 0.01 * abs(step)
    if step <= 0 or min(one.mean() for one in alike) < _REGULAR:
        return None
    rate = float(np.mean(runs)) / step
    text = (
        f"time stamps are rounded to {step:.4g} s: {repeated} of {len(t)} repeat the one before, "
        f"and their samples would be lost; write rate = '{rate:.4g} Hz' in place of time, or "
        "record finer stamps"
    )
    edit = f"rate = '{rate:.4g} Hz' in place of time, or finer stamps"
    return Finding("time", repeated, text, contradiction=True, edit=edit)


def _edit_of_falls(t: Array, before: int) -> str:
    """Return what to do about stamps (N,) that fall: the longest part between those of a clock that
    was set back, by its rows in the file."""
    rows = np.flatnonzero(np.isfinite(t))
    falls = np.flatnonzero(np.diff(t[rows]) < 0)
    if len(falls) > _RESETS:
        return "sort the rows of the file by time, or state rate in place of time"
    parts = np.split(rows, falls + 1)
    longest = max(parts, key=len)
    return f"rows = [{before + longest[0] + 1}, {before + longest[-1] + 1}], the longest run"


def _wild(t: Array) -> Array:
    """Return rows (N,) whose stamp lies far from the median line of its neighbours."""
    wild = np.zeros(len(t), dtype=bool)
    rows = np.flatnonzero(np.isfinite(t))
    steps = np.diff(t[rows])
    rising = steps[steps > 0]
    if len(rows) < _WINDOW or len(rising) < len(steps) / 2:
        return wild
    step = float(np.median(rising))
    deviation = t[rows] - step * np.arange(len(rows))
    if np.ptp(deviation) <= _FAR * step:  # no stamp is that far from any other's line
        return wild
    # Lost samples move the line for good: its running median moves with them.
    windows = sliding_window_view(np.pad(deviation, _WINDOW // 2, mode="symmetric"), _WINDOW)
    parts = np.split(windows, range(_BLOCK, len(windows), _BLOCK))
    middle = np.concatenate([np.median(part, axis=1) for part in parts])
    deviation = np.abs(deviation - middle)
    wild[rows] = deviation > _FAR * (step + float(np.median(deviation)))
    return wild


def _increasing(t: Array) -> tuple[Array, int, int]:
    """Return stamps (N,), NaN outside of the longest increasing series, and the numbers of those
    that repeat the stamp before and of the others."""
    rows = np.flatnonzero(np.isfinite(t))
    stamps = t[rows]
    if (np.diff(stamps) > 0).all():
        return t, 0, 0
    chosen = np.zeros(len(stamps), dtype=bool)
    chosen[_longest_increasing(stamps.tolist())] = True
    dropped = np.flatnonzero(~chosen)
    latest = np.maximum.accumulate(np.where(chosen, stamps, -np.inf))
    repeated = int((stamps[dropped] == latest[dropped]).sum())
    kept = t.copy()
    kept[rows[dropped]] = np.nan
    return kept, repeated, len(dropped) - repeated


def _longest_increasing(stamps: list[float]) -> list[int]:
    """Return the indices of the longest strictly increasing series; of equal stamps the first."""
    ends: list[float] = []  # smallest end of a series of each length
    at: list[int] = []
    before = [-1] * len(stamps)
    # Patience sorting, O(n log n).
    for i, stamp in enumerate(stamps):
        length = bisect_left(ends, stamp)
        if length < len(ends) and ends[length] == stamp:
            continue
        before[i] = at[length - 1] if length else -1
        ends[length : length + 1] = [stamp]
        at[length : length + 1] = [i]
    series, last = [], at[-1] if at else -1
    while last >= 0:
        series.append(last)
        last = before[last]
    return series[::-1]
