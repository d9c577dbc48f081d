"""Entries of a table: statistics of the cells that share their labels, and their intervals."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_bench.evaluation.intervals import TABLE_REPEATS, percentile_interval
from sysid_bench.evaluation.repeat_statistic import repeat_statistic
from sysid_bench.reporting.selection import TableLayout, label
from sysid_bench.reporting.tables import Entry, Key
from sysid_bench.types import Metric
from sysid_bench.words import OF_REPEATS

if TYPE_CHECKING:
    import pandas as pd


Interval = tuple[float | None, float | None]


def statistic_of(stat: str, values: np.ndarray) -> float:
    """A statistic of finite values (n,), n > 0."""
    return float(_along_last(stat, values))


def interval_of(interval: str, stat: str, values: np.ndarray, repeats: np.ndarray) -> Interval:
    """(low, high) for finite values (n,) of the given repeats (n,); (None, None) where two values
    (or, for "ci95", two repeats) are missing, and for counts."""
    if interval == "none" or stat == "count" or len(values) < 2:
        return None, None
    if interval == "ci95":
        # Whole repeats are drawn: the cells of one repeat share their noise, and drawn singly
        # would count as independent.
        names, which = np.unique(repeats.astype(str), return_inverse=True)
        if len(names) < TABLE_REPEATS.fewest:
            return None, None
        # One row per repeat: a draw of rows is a draw of repeats, all of them at once.
        blocks = np.full((len(names), np.bincount(which).max()), np.nan)
        for i in range(len(names)):
            block = values[which == i]
            blocks[i, : len(block)] = block
        drawn = blocks[TABLE_REPEATS.indices(len(names))].reshape(TABLE_REPEATS.draws, -1)
        low, high = percentile_interval(_along_last(stat, drawn))
        return float(low), float(high)
    # The others describe the values, not the accuracy of their statistic.
    if interval == "iqr":
        low, high = np.percentile(values, [25, 75])
    elif interval == "range":
        low, high = values.min(), values.max()
    else:
        centre, spread = statistic_of(stat, values), values.std(ddof=1)
        low, high = centre - spread, centre + spread
    return float(low), float(high)


def _along_last(stat: str, values: np.ndarray) -> np.ndarray:
    if stat == "count":
        return np.asarray(np.isfinite(values).sum(axis=-1))
    # Blocks of unequal repeats are filled with NaN; every draw holds at least one number.
    functions: dict[str, Callable[..., np.ndarray]] = {
        "median": np.nanmedian,
        "mean": np.nanmean,
        "min": np.nanmin,
        "max": np.nanmax,
    }
    return np.asarray(functions[stat](values, axis=-1))


Entries = dict[tuple[Key, Key], Entry]


def table_entries(
    cells: "pd.DataFrame", layout: TableLayout, parameters: "pd.DataFrame | None"
) -> Entries:
    """Entries by row and column key; the name of the metric ends the column key where metrics are
    columns. `parameters` as of build_table."""
    rows, entries = len(layout.rows), {}
    for metric in layout.metrics:
        name = (metric.name,) if layout.has_metric_columns else ()
        # dropna=False: a cell without a label is a group of its own, and does not vanish.
        for found, group in cells.groupby(list(layout.fields), sort=False, dropna=False):
            labels = tuple(map(label, found if isinstance(found, tuple) else (found,)))
            key = labels[:rows], labels[rows:] + name
            entries[key] = _entry(group, metric, layout, parameters)
    return entries


def _entry(
    group: "pd.DataFrame", metric: Metric, layout: TableLayout, parameters: "pd.DataFrame | None"
) -> Entry:
    ok = group[group["status"] == "ok"]
    failures = group.loc[group["status"] != "ok", "status"].value_counts(sort=False)
    counts = {str(kind): int(number) for kind, number in failures.items()}
    if metric.level in OF_REPEATS:
        # A figure of all repeats, the cells each one of one setting; a scatter needs the single
        # repeats, since the row of a cell has no parameters.
        figure = None if parameters is None else repeat_statistic(metric.name, ok, parameters)
        if figure is None:
            return Entry(None, None, None, 0, counts, len(ok))
        ends: Interval = figure[1:] if layout.interval != "none" else (None, None)
        return Entry(figure[0], *ends, len(ok), counts)
    # Where every cell failed, no row has the metric at all.
    given = ok.get(metric.name, [None] * len(ok))
    if metric.text:
        # One text where all cells have the same, else each with its count.
        texts = [value for value in given if isinstance(value, str)]
        met = Counter(texts)
        each = met if len(met) == 1 else (f"{word} {n}" for word, n in met.most_common())
        missing = len(ok) - len(texts)
        return Entry(None, None, None, len(texts), counts, missing, text=", ".join(each))
    values = metric.scale * np.array(list(map(_number, given)), dtype=float)
    finite, repeats = np.isfinite(values), np.asarray(ok.get("repeat", range(len(ok))))
    kept = values[finite]
    low, high = interval_of(layout.interval, layout.stat, kept, repeats[finite])
    value = statistic_of(layout.stat, kept) if len(kept) else None
    return Entry(value, low, high, len(kept), counts, len(values) - len(kept))


def _number(value: Any) -> float:
    """A value as a number: Parquet and JSON hand whole numbers, booleans and None in one column
    of objects."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return np.nan
