"""Tables that signals of a log come from: its file, their own files, or several joined by time."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, first_names, unknown_name
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import LogDescription
from sysid_bench.signals.log_keys import Signal, Source, Time
from sysid_bench.signals.log_preset import preset_note
from sysid_bench.signals.log_reader import read_table
from sysid_bench.signals.log_table import LogTable, table_of_rows
from sysid_bench.signals.log_times import check_times, read_times
from sysid_bench.types import Array
from sysid_bench.units import quantity

_WIDE: Final = 5.0
"""Median steps; in longer gaps of a file its signals have no values at the stamps of another."""


def table_of(log: LogDescription, part: Signal | Time) -> LogTable:
    """Return the table of a signal, a row per sample, or of the stamps; raises UsageError for files
    or columns that do not exist."""
    table = _whole_table(log, part)
    if isinstance(part, Signal) and part.per_row is not None:
        return table_of_rows(table, part.per_row)
    return table


def _whole_table(log: LogDescription, part: Signal | Time) -> LogTable:
    if log.data is not None:
        return log.data
    if log.sources and part.file is None:
        return merge_sources(log).table
    return read_table(log.file_of(part), log.reader_of(part))


def select_columns(log: LogDescription, part: Signal, table: LogTable) -> tuple[int | str, ...]:
    """Return the columns of a signal: those written, or those whose names match."""
    if part.match is None or (log.sources and part.file is None):
        return part.columns or tuple(_matching(log, part.match or "", table.names))
    return tuple(_matching(log, part.match, table.names))


def _matching(log: LogDescription, pattern: str, names: Iterable[str]) -> list[str]:
    """Return the names that match a whole pattern, by the number in its group.

    Raises UsageError for none, or for a pattern that is not one.
    """
    try:
        found = {name: hit for name in names if (hit := re.fullmatch(pattern, name)) is not None}
        ordered = sorted(found, key=lambda name: int(found[name][1]))
    except (re.error, IndexError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise UsageError(
            f"{log.source}: match = {pattern!r} has to be a regular expression with one group of "
            "digits, as 'q_(\\d+)'."
        ) from error
    if not ordered:
        raise UsageError(
            f"{log.source}: no column matches {pattern!r}; there are {first_names(names, 8)}."
        )
    return ordered


@dataclass(frozen=True, eq=False)
class _Joined:
    """Table of several files at the stamps `t` (N,), and how it was made."""

    table: LogTable
    t: Array
    finding: Finding


@dataclass(frozen=True, eq=False)
class _Opened:
    """Table of one source, and its stamps (s), increasing, NaN where a row has none."""

    source: Source
    table: LogTable
    t: Array

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp."""
        return float(np.nanmin(self.t)), float(np.nanmax(self.t))


@lru_cache(maxsize=1)
def merge_sources(log: LogDescription) -> _Joined:
    """Return the columns of several files at the stamps of the first within the span that all have.

    Columns of the others are interpolated linearly, or hold their last value, as their signal
    says. Raises UsageError for files without stamps or an overlap, and for a name that two have.
    """
    opened = [_opened(log, source) for source in log.sources]
    start = max(one.span[0] for one in opened)
    end = min(one.span[1] for one in opened)
    first = opened[0]
    rows = (first.t >= start) & (first.t <= end)
    if rows.sum() < 2:
        spans = ", ".join(f"{one.source.file} {_span_text(one)}" for one in opened)
        raise UsageError(
            f"{log.source}: the files do not overlap in time ({spans}); give the offset of a clock "
            "with file = [..., { file = 'b.csv', offset = '-3.2 s' }]."
        )
    t = first.t[rows]
    return _Joined(_joined_table(log, opened, rows), t, _finding(opened, t, len(rows)))


def _span_text(one: _Opened) -> str:
    return "{:.6g} ... {:.6g} s".format(*one.span)


def _finding(opened: Sequence[_Opened], t: Array, rows: int) -> Finding:
    others = ", ".join(one.source.file for one in opened[1:])
    text = (
        f"{others}: joined by name at the stamps of {opened[0].source.file}, linear for signals, "
        f"the previous value for commands, over the common {t[-1] - t[0]:.4g} s; "
        f"{rows - len(t)} of {rows} samples lie outside"
    )
    return Finding("joined", rows - len(t), text)


def _opened(log: LogDescription, source: Source) -> _Opened:
    time = source.time or log.time
    if time is None:
        raise UsageError(
            f"{log.source}: several files are joined by their time stamps; write time = the column "
            "that holds them."
        )
    table = read_table(log.file_of(source), log.reader_of(source))
    t, _ = check_times(read_times(log, time, table))
    if np.isfinite(t).sum() < 2:
        raise UsageError(f"{log.source}: the time stamps of {source.file} do not rise.")
    return _Opened(source, table, t + quantity(source.offset, "s"))


def _joined_table(log: LogDescription, opened: Sequence[_Opened], rows: Array) -> LogTable:
    """Return the columns of all signals without a file of their own."""
    parts: dict[str, Array] = {}
    for part in log.columns:
        if part.file is None:
            for name in _written(log, part, opened):
                owner = _owner(log, name, opened)
                parts[name] = _resampled(owner, name, opened[0], part.resample == "previous")[rows]
    values, names = np.concatenate(list(parts.values()), axis=1), {}
    first = 0
    for name, part_values in parts.items():
        names[name] = tuple(range(first, first + part_values.shape[1]))
        first += part_values.shape[1]
    truncated = max(one.table.truncated for one in opened)
    return LogTable(log.source, values, names, truncated)


def _written(log: LogDescription, part: Signal, opened: Sequence[_Opened]) -> list[str]:
    """Return the columns of a signal by name; raises UsageError for an index."""
    if part.match is not None:
        return _matching(log, part.match, _every_name(opened))
    by_index = [column for column in part.columns if not isinstance(column, str)]
    if by_index:
        raise UsageError(
            f"{log.source}: column {by_index[0]} of which file? Name the columns of joined files, "
            "or give the signal a file of its own."
        )
    return [str(column).strip() for column in part.columns]


def _every_name(opened: Sequence[_Opened]) -> list[str]:
    return list(chain.from_iterable(one.table.names for one in opened))


def _owner(log: LogDescription, name: str, opened: Sequence[_Opened]) -> _Opened:
    """Return the file that has a column; raises UsageError where none has it, or two."""
    owners = [one for one in opened if name in one.table.names]
    if len(owners) == 1:
        return owners[0]
    if owners:
        files = " and ".join(one.source.file for one in owners)
        raise UsageError(
            f"{log.source}: {files} both have a column {name!r}; rename one, or give the signal a "
            "file of its own."
        )
    every = dict.fromkeys(_every_name(opened))
    raise UsageError(f"{log.source}: {unknown_name('column', name, every, preset_note(every))}")


def _resampled(owner: _Opened, name: str, first: _Opened, previous: bool) -> Array:
    """Return a column, or the columns of an array, at the stamps of the first file (N, k)."""
    x: Array = owner.table.columns([name])
    if owner is first:
        return x
    kept = np.isfinite(owner.t)
    t, x = owner.t[kept], x[kept]
    before = np.clip(np.searchsorted(t, first.t, side="right") - 1, 0, len(t) - 1)
    if previous:
        held: Array = x[before]
    else:
        held = np.stack([np.interp(first.t, t, column) for column in x.T], axis=1)
    steps = np.diff(t)
    wide = steps > _WIDE * np.median(steps)
    inside = np.minimum(before, len(steps) - 1)
    held[wide[inside] & (first.t > t[inside])] = np.nan
    return held
