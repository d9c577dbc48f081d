"""Time stamps of a file in seconds, without those that leave the line of their neighbours."""

from bisect import bisect_left
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_keys import Time
from sysid_bench.signals.log_table import LogTable
from sysid_bench.types import Array

TOO_MANY: Final = 0.2
"""Share of stamps that leave the line or run backwards beyond which the column is not time."""

_SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

_WINDOW: Final = 41
"""Samples around a stamp that predict it; up to half of them may be wrong."""

_BLOCK: Final = 10_000
"""Windows whose medians are taken at once."""

_FAR: Final = 20.0
"""Median steps, and median deviations, from that line beyond which a stamp is wild."""


def read_times(log: LogDescription, time: Time, table: LogTable) -> Array:
    """Return the stamps (N,) of a whole table in s; raises UsageError for a wrong unit."""
    values = table.columns(time.column)
    units = time.unit * values.shape[1] if len(time.unit) == 1 else time.unit
    scale = np.array([_seconds(log, unit) for unit in units])
    if len(time.column) == 1 != values.shape[1]:
        raise UsageError(f"{log.source}: time must be one column; got {values.shape[1]}.")
    if len(units) != values.shape[1]:
        raise UsageError(
            f"{log.source}: time has {len(units)} units for {values.shape[1]} columns."
        )
    return np.asarray(values @ scale)


def _seconds(log: LogDescription, unit: str) -> float:
    if unit not in _SECONDS:
        raise UsageError(f"{log.source}: time: {unknown_name('unit', unit, _SECONDS)}")
    return _SECONDS[unit]


def check_times(t: Array) -> tuple[Array, list[Finding]]:
    """Return stamps (N,) that increase, NaN for the others, and findings of those left out.

    A stamp far from the line of its neighbours is left out first, so that it costs one row; of the
    rest, the longest series that increases is kept.
    """
    wild = _wild(t)
    kept, repeated, backwards = _increasing(np.where(wild, np.nan, t))
    limit = TOO_MANY * len(t)
    counts = (
        (int(wild.sum()), "time stamps leave the line of their neighbours"),
        (repeated, "time stamps are repeated"),
        (backwards, "time stamps run backwards"),
    )
    found = [
        Finding("time", count, f"{count} {text}", count > limit and text != counts[1][1])
        for count, text in counts
        if count
    ]
    return kept, found


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
    deviation = np.abs(deviation - _running_median(deviation))
    wild[rows] = deviation > _FAR * (step + float(np.median(deviation)))
    return wild


def _running_median(x: Array) -> Array:
    """Return the median (N,) of the _WINDOW samples around each; ends are reflected."""
    padded = np.pad(x, _WINDOW // 2, mode="symmetric")
    windows = sliding_window_view(padded, _WINDOW)
    parts = np.split(windows, range(_BLOCK, len(windows), _BLOCK))
    return np.concatenate([np.median(part, axis=1) for part in parts])


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
    for i, stamp in enumerate(stamps):
        length = bisect_left(ends, stamp)
        if length < len(ends) and ends[length] == stamp:
            continue
        before[i] = at[length - 1] if length else -1
        ends[length : length + 1] = [stamp]
        at[length : length + 1] = [i]
    return _traced(before, at[-1] if at else -1)


def _traced(before: list[int], last: int) -> list[int]:
    """Return the indices that lead to the last one, each preceded by that `before` it."""
    series = []
    while last >= 0:
        series.append(last)
        last = before[last]
    return series[::-1]
