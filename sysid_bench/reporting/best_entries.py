"""The best entries of a table: among estimators where these are rows or columns, else in a row."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from sysid_bench.reporting.tables import Key, Table

_Position = tuple[Key, Key]
_Choice = Callable[..., Any]  # min or max
_MARKS: dict[str, _Choice] = {"min-bold": min, "max-bold": max}
_DIRECTIONS: dict[str | None, _Choice] = {"lower": min, "higher": max}


def with_best(table: Table, best: str) -> Table:
    """The table with its best entries marked: "min-bold", "max-bold", or "bold" by the direction
    of each metric, where a metric without direction has no best; "none" marks nothing."""
    if best == "none":
        return table
    winners = set(_winners(table, best))
    marked = {key: replace(entry, best=key in winners) for key, entry in table.entries.items()}
    return replace(table, entries=marked)


def _winners(table: Table, best: str) -> Iterator[_Position]:
    for keys in _competitions(table):
        metric = table.metric_of(keys[0][1])
        choice = _MARKS.get(best, _DIRECTIONS.get(metric.better))
        values = _above_floor(table, keys, metric.floor * metric.scale)
        # Equal values of all, as the condition number of data that they share, are no merit.
        if choice and values and (len(values) == 1 or len({*values.values()}) > 1):
            yield from _printed_alike(table, choice(values, key=values.__getitem__), values)


def _competitions(table: Table) -> Iterator[list[_Position]]:
    """Keys of entries of one metric that compete: two at least."""
    groups: dict[tuple[Key, str], list[_Position]] = {}
    for key in table.entries:
        metric = table.metric_of(key[1]).name
        groups.setdefault((_competition(table, key), metric), []).append(key)
    return (keys for keys in groups.values() if len(keys) > 1)


def _competition(table: Table, key: _Position) -> Key:
    """Labels that entries share which compete: all but the estimator, or the row and the plant. A
    plant is never better than another: realism levels do not compete."""
    fields = table.row_fields + table.column_fields
    shared = (*table.row_fields, "plant")
    return tuple(
        part
        for field, part in zip(fields, sum(key, ()), strict=True)
        if (field != "estimator" if "estimator" in fields else field in shared)
    )


def _above_floor(table: Table, keys: list[_Position], floor: float) -> dict[_Position, float]:
    """Values of the entries that have one, moved to the floor; empty where all lie below it."""
    values = {key: v for key in keys if (v := table.entries[key].value) is not None}
    # Below the floor all values are rounding: none is better than another.
    if max(map(abs, values.values()), default=0.0) < floor:
        return {}
    return {key: math.copysign(max(abs(v), floor), v) for key, v in values.items()}


def _printed_alike(
    table: Table, first: _Position, values: Mapping[_Position, float]
) -> list[_Position]:
    """Keys whose number prints like that of the first: the reader sees them as equal."""
    text = table.column_notation[first[1]].text
    return [key for key, value in values.items() if text(value) == text(values[first])]
