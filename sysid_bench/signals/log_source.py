"""Tables and time stamps that a log comes from: its file, files of single signals, or several that
are joined by time."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, first_names, unknown_name
from sysid_bench.signals.column_names import joint_in
from sysid_bench.signals.log_checks import Finding
from sysid_bench.signals.log_description import LogDescription, own_time
from sysid_bench.signals.log_keys import Signal, Source, Time, preset_note
from sysid_bench.signals.log_reader import read_table
from sysid_bench.signals.log_table import LogTable, table_of_rows
from sysid_bench.signals.time_base import check_times
from sysid_bench.types import Array
from sysid_bench.units import quantity

_SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

_WIDE: Final = 5.0
"""Median steps; in longer gaps of a file its signals have no values at the stamps of another."""


def table_of(log: LogDescription, part: Signal | Time) -> LogTable:
    """Return the table of a signal, a row per sample, or of the stamps; raises UsageError for files
    or columns that do not exist."""
    if log.data is not None:
        table = log.data
    elif log.sources and part.file is None:
        table = merge_sources(log).table
    else:
        table = read_table(log.file_of(part), log.reader_of(part))
    if isinstance(part, Signal) and part.per_row is not None:
        return table_of_rows(table, part.per_row)
    return table


def read_columns(log: LogDescription, part: Signal) -> tuple[LogTable, Array]:
    """Return the table of a signal and its numbers (N, k), at the stamps of the log where its file
    has a clock of its own; raises UsageError for files or columns that do not exist."""
    table = table_of(log, part)
    chosen = part.columns if part.match is None else _matching(log, part.match, table.names)
    x = table.columns(chosen)
    time, common = own_time(part), _stamps(log)
    if time is None or time == log.time or common is None:
        return table, x
    t, _ = check_times(_read_times(log, time, table_of(log, time)))
    if np.isfinite(t).sum() < 2 or abs(len(t) - len(x)) > 1:
        raise UsageError(
            f"{log.source}: {part.file}: {np.isfinite(t).sum()} time stamps that rise for {len(x)} "
            "samples; check time of this signal."
        )
    known = min(len(t), len(x))
    return table, _at_stamps(t[:known], x[:known], common, part.resample == "previous")


def clocks_finding(log: LogDescription) -> list[Finding]:
    """Return what was joined by time: files by name, or signals by their own clocks."""
    if log.sources:
        return [merge_sources(log).finding]
    times = {name: own_time(part) for name, part in log.signals.items()}
    apart = [name for name, time in times.items() if time is not None and time != log.time]
    if not apart:
        return []
    text = (
        f"{', '.join(apart)}: each by its own clock at the common time stamps, linear for signals, "
        "the previous value for commands"
    )
    return [Finding("joined", len(apart), text)]


def _matching(log: LogDescription, pattern: str, names: Iterable[str]) -> list[str]:
    """Return the names that match a whole pattern, by the number in its group, or else by the joint
    that each names.

    Raises UsageError for none, or for a pattern that is not one.
    """
    try:
        found = {name: hit for name in names if (hit := re.fullmatch(pattern, name)) is not None}
        keys = {name: hit[1] if hit.re.groups else name for name, hit in found.items()}
        if found and all(key.isdecimal() for key in keys.values()):
            return sorted(found, key=lambda name: int(keys[name]))
    except (re.error, AttributeError, ValueError, RecursionError, OverflowError) as error:
        raise UsageError(
            f"{log.source}: match = {pattern!r} is not a regular expression with a group that is "
            f"always there, as 'q_(\\d+)' or '.*_position': {error}."
        ) from error
    if not found:
        raise UsageError(
            f"{log.source}: no column matches {pattern!r}; there are {first_names(names, 8)}."
        )
    owners = {name: joint_in(key, log.joints) for name, key in keys.items()}
    by_joint = {joint: name for name, joint in owners.items() if joint}
    if len(by_joint) < len(log.joints) or len(by_joint) < sum(map(bool, owners.values())):
        raise UsageError(
            f"{log.source}: match = {pattern!r} finds {first_names(found, 8)}: one of them "
            f"must name each of the joints {first_names(log.joints, 8)}; or give them numbers, as "
            "'q_(\\d+)'."
        )
    return [by_joint[joint] for joint in log.joints]


def read_time(log: LogDescription, samples: int) -> Array | None:
    """Return the time stamps (N,) of the chosen samples in s, as they stand in the file; None
    without a time column.

    Raises UsageError for a wrong unit, column or length.
    """
    stamps = _stamps(log)
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


def _stamps(log: LogDescription) -> Array | None:
    """Return the stamps of all samples (s), None without a time column."""
    if log.sources and (log.time is None or log.time.file is None):
        return merge_sources(log).t
    return None if log.time is None else _read_times(log, log.time, table_of(log, log.time))


def _read_times(log: LogDescription, time: Time, table: LogTable) -> Array:
    """Return the stamps (N,) of a whole table in s; raises UsageError for a wrong unit."""
    values = table.columns(time.column)
    units = time.unit * values.shape[1] if len(time.unit) == 1 else time.unit
    for unit in units:
        if unit not in _SECONDS:
            raise UsageError(f"{log.source}: time: {unknown_name('unit', unit, _SECONDS)}")
    if len(time.column) == 1 != values.shape[1]:
        raise UsageError(f"{log.source}: time must be one column; got {values.shape[1]}.")
    if len(units) != values.shape[1]:
        raise UsageError(
            f"{log.source}: time has {len(units)} units for {values.shape[1]} columns."
        )
    return np.asarray(values @ np.array([_SECONDS[unit] for unit in units]))


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
    start, end = max(one.span[0] for one in opened), min(one.span[1] for one in opened)
    first = opened[0]
    rows = (first.t >= start) & (first.t <= end)
    if rows.sum() < 2:
        spans = ", ".join(
            "{} {:.6g} ... {:.6g} s".format(one.source.file, *one.span) for one in opened
        )
        raise UsageError(
            f"{log.source}: the files do not overlap in time ({spans}); give the offset of a clock "
            "with file = [..., { file = 'b.csv', offset = '-3.2 s' }]."
        )
    parts: dict[str, Array] = {}
    for part in log.columns:
        if part.file is None:
            for name in _written(log, part, opened):
                owner = _owner(log, name, opened)
                x = owner.table.columns([name])
                if owner is not first:
                    x = _at_stamps(owner.t, x, first.t, part.resample == "previous")
                parts[name] = x[rows]
    names, width = {}, 0
    for name, x in parts.items():
        names[name] = tuple(range(width, width + x.shape[1]))
        width += x.shape[1]
    values = np.concatenate(list(parts.values()), axis=1)
    t, outside = first.t[rows], len(rows) - int(rows.sum())
    text = (
        f"{', '.join(one.source.file for one in opened[1:])}: joined by name at the stamps of "
        f"{first.source.file}, linear for signals, the previous value for commands, over the "
        f"common {t[-1] - t[0]:.4g} s; {outside} of {len(rows)} samples lie outside"
    )
    table = LogTable(log.source, values, names, max(one.table.truncated for one in opened))
    return _Joined(table, t, Finding("joined", outside, text))


def _opened(log: LogDescription, source: Source) -> _Opened:
    time = source.time or log.time
    if time is None:
        raise UsageError(
            f"{log.source}: several files are joined by their time stamps; write time = the column "
            "that holds them."
        )
    table = read_table(log.file_of(source), log.reader_of(source))
    t, _ = check_times(_read_times(log, time, table))
    if np.isfinite(t).sum() < 2:
        raise UsageError(f"{log.source}: the time stamps of {source.file} do not rise.")
    return _Opened(source, table, t + quantity(source.offset, "s"))


def _written(log: LogDescription, part: Signal, opened: Sequence[_Opened]) -> list[str]:
    """Return the columns of a signal by name; raises UsageError for an index."""
    if part.match is not None:
        return _matching(log, part.match, list(chain(*(one.table.names for one in opened))))
    for column in part.columns:
        if not isinstance(column, str):
            raise UsageError(
                f"{log.source}: column {column} of which file? Name the columns of joined files, "
                "or give the signal a file of its own."
            )
    return [str(column).strip() for column in part.columns]


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
    every = dict.fromkeys(chain(*(one.table.names for one in opened)))
    raise UsageError(f"{log.source}: {unknown_name('column', name, every, preset_note(every))}")


def _at_stamps(t: Array, x: Array, at: Array, previous: bool) -> Array:
    """Return x (N, k), measured at the stamps t, at others (M, k): linear between them, or the
    previous value; NaN in wide gaps, and beyond the ends by more than a step."""
    kept = np.isfinite(t)
    t, x = t[kept], x[kept]
    before = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 1)
    held: Array = x[before]
    if not previous:
        held = np.stack([np.interp(at, t, column) for column in x.T], axis=1)
    steps = np.diff(t)
    step = float(np.median(steps))
    wide = steps > _WIDE * step
    inside = np.minimum(before, len(steps) - 1)
    held[wide[inside] & (at > t[inside])] = np.nan
    # A command holds on; a measurement is not known beyond its last sample.
    held[(at < t[0] - step) | ((at > t[-1] + step) & (not previous))] = np.nan
    return held
