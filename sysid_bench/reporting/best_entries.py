"""The best entries of a table: among estimators where these are rows or columns, else in a row."""

from dataclasses import replace

from sysid_bench.reporting.tables import Key, Table

_SIGNS = {"min-bold": 1, "max-bold": -1}
_DIRECTIONS = {"lower": 1, "higher": -1, None: 0}


def with_best(table: Table, best: str) -> Table:
    """The table with its best entries marked: "min-bold", "max-bold", or "bold" by the direction
    of each metric, where a metric without direction has no best; "none" marks nothing."""
    if best == "none":
        return table
    groups: dict[tuple[Key, int], list[tuple[Key, Key]]] = {}
    for key in table.entries:
        sign = _SIGNS.get(best, _DIRECTIONS[table.metric_of(key[1]).better])
        if sign:
            groups.setdefault((_competition(table, key), sign), []).append(key)
    winners = {key for (_, sign), keys in groups.items() for key in _winners(table, keys, sign)}
    marked = {key: replace(entry, best=key in winners) for key, entry in table.entries.items()}
    return replace(table, entries=marked)


def _competition(table: Table, key: tuple[Key, Key]) -> Key:
    """Labels that entries share which compete: all but the estimator, or row and metric."""
    fields = table.row_fields + table.column_fields
    if "estimator" not in fields:
        return (*key[0], table.metric_of(key[1]).name)
    return tuple(part for f, part in zip(fields, sum(key, ()), strict=True) if f != "estimator")


def _winners(table: Table, keys: list[tuple[Key, Key]], sign: int) -> list[tuple[Key, Key]]:
    values = {key: v for key in keys if (v := table.entries[key].value) is not None}
    floor = table.metric_of(keys[0][1]).floor
    # Below the floor all values are rounding: none is better than another.
    if len(keys) < 2 or not values or all(abs(v) < floor for v in values.values()):
        return []
    values = {key: max(v, floor) if v >= 0 else min(v, -floor) for key, v in values.items()}
    first = min(values, key=lambda key: sign * values[key])
    # Numbers that print alike are equal to the reader: all of them are best.
    text = table.column_notation[first[1]].text
    return [key for key, value in values.items() if text(value) == text(values[first])]
