"""Tables from cells: selection, grouping, statistics, marks of the best, notes."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.evaluation.intervals import REPEATS
from sysid_bench.evaluation.repeat_statistic import SETTING
from sysid_bench.metrics import METRICS, REASONS
from sysid_bench.reporting.baseline_rows import BASELINES, ERROR, captions, with_baselines
from sysid_bench.reporting.selection import (
    SWEEPABLE,
    Choose,
    TableLayout,
    label,
    layout_of,
    select_rows,
    with_labels,
)
from sysid_bench.reporting.table_entries import Entries, table_entries
from sysid_bench.reporting.tables import ABSENT, Key, Table
from sysid_bench.types import Metric
from sysid_bench.words import FRAME_DEPENDENT, INTERVAL_LIMITS, OF_REPEATS, STD_FROM

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class MainEffects:
    """Least squares of log x_ij = m + r_i + c_j over a complete grid of positive values.

    `rows` exp(r_i) and `columns` exp(c_j) are ratios to the geometric mean of the grid, `shares`
    the parts of the variance of log x_ij due to rows, columns and neither (their interaction).
    """

    rows: np.ndarray
    columns: np.ndarray
    shares: tuple[float, float, float]


ROUNDING: Final = 1e-13
"""Relative rounding of logarithms and their mean."""


def main_effects(values: np.ndarray) -> MainEffects:
    """The main effects of positive values (rows, columns)."""
    # Settings multiply errors: in logarithms their effects add up.
    raw = np.log(values)
    log = raw - raw.mean()
    if np.abs(log).max() <= ROUNDING * max(1.0, float(np.abs(raw).max())):
        log = 0.0 * log  # equal values: what the mean leaves is rounding, and has no parts
    r, c = log.mean(axis=1), log.mean(axis=0)
    parts = [r[:, None] + 0 * log, c[None, :] + 0 * log, log - r[:, None] - c[None, :]]
    total = float((log**2).sum()) or 1.0
    by_row, by_column, neither = (float((part**2).sum()) / total for part in parts)
    return MainEffects(np.exp(r), np.exp(c), (by_row, by_column, neither))


def effect_notes(entries: Entries, fields: tuple[Key, Key]) -> Iterator[str]:
    """Sentences with the main effects of the row and column `fields` of a table, over the rows
    whose values are complete and positive."""
    every_row = list(dict.fromkeys(row for row, _ in entries))
    columns = list(dict.fromkeys(column for _, column in entries))
    rows = _positive_rows(entries, every_row, columns)
    if len(rows) < 2 or len(columns) < 2:
        yield "Main effects need two rows and two columns with positive numbers throughout."
        return
    values = np.array([[entries[row, column].value for column in columns] for row in rows], float)
    found, (of_rows, of_columns) = main_effects(values), map(" / ".join, fields)
    shares = zip((of_rows, of_columns, "both together"), found.shares, strict=True)
    yield (
        "Main effects, as ratios to the geometric mean of the entries: "
        f"{of_rows}: {_ratio_text(rows, found.rows)}; "
        f"{of_columns}: {_ratio_text(columns, found.columns)}."
    )
    listed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares)
    yield f"Share of the variance of the logarithms: {listed}."
    left_out = [" / ".join(row) for row in every_row if row not in rows]
    if left_out:
        yield f"Without an effect, for want of numbers: {', '.join(dict.fromkeys(left_out))}."


def _positive_rows(entries: Entries, rows: list[Key], columns: list[Key]) -> list[Key]:
    """Rows with a positive number in each column."""
    sizes = {key: entry.value or 0.0 for key, entry in entries.items()}
    return [row for row in rows if all(sizes.get((row, one), 0.0) > 0 for one in columns)]


def _ratio_text(keys: Iterable[Key], ratios: np.ndarray) -> str:
    pairs = zip(keys, ratios, strict=True)
    return ", ".join(f"{' / '.join(key)} {ratio:.3g}" for key, ratio in pairs)


_Position = tuple[Key, Key]
_Choice = Callable[..., Any]  # min or max
_MARKS: dict[str, _Choice] = {"min-bold": min, "max-bold": max}
_DIRECTIONS: dict[str | None, _Choice] = {"lower": min, "higher": max}


def with_best(table: Table, best: str) -> Table:
    """The table with its best entries marked: "min-bold", "max-bold", or "bold" by the direction
    of each metric, where a metric without direction has no best; "none" marks nothing."""
    if best == "none":
        return table
    winners = set[_Position]()
    for keys in _competitions(table):
        metric = table.metric_of(keys[0][1])
        choice = _MARKS.get(best, _DIRECTIONS.get(metric.better))
        # Errors below the floor are one number: a smaller rounding error is not a merit.
        values = _above_floor(table, keys, metric.floor * metric.scale)
        # Equal values of all, as the condition number of data that they share, are no merit.
        if choice and values and (len(values) == 1 or len({*values.values()}) > 1):
            # Keys whose number prints like that of the first: the reader sees them as equal.
            first = choice(values, key=values.__getitem__)
            text = table.column_notation[first[1]].text
            winners |= {key for key, value in values.items() if text(value) == text(values[first])}
    marked = {key: replace(entry, best=key in winners) for key, entry in table.entries.items()}
    return replace(table, entries=marked)


def _competitions(table: Table) -> Iterator[list[_Position]]:
    """Keys of entries of one metric that compete: two at least."""
    fields = table.row_fields + table.column_fields
    # Estimators compete where all other labels agree; without estimators, the columns of a row do.
    # A plant is never better than another: realism levels do not compete.
    if "estimator" in fields:
        shared = {field for field in fields if field != "estimator"}
    else:
        shared = {*table.row_fields, "plant"}
    groups: dict[tuple[Key, str], list[_Position]] = {}
    for key in table.entries:
        if BASELINES.keys() & {*sum(key, ())}:
            continue
        labels = zip(fields, sum(key, ()), strict=True)
        competition = tuple(part for field, part in labels if field in shared)
        groups.setdefault((competition, table.metric_of(key[1]).name), []).append(key)
    return (keys for keys in groups.values() if len(keys) > 1)


def _above_floor(table: Table, keys: list[_Position], floor: float) -> dict[_Position, float]:
    """Values of the entries that have one, moved to the floor; empty where all lie below it."""
    values = {key: v for key in keys if (v := table.entries[key].value) is not None}
    # Below the floor all values are rounding: none is better than another.
    if max(map(abs, values.values()), default=0.0) < floor:
        return {}
    return {key: math.copysign(max(abs(v), floor), v) for key, v in values.items()}


PLANT: Final = "plant"
OF_PLANTS: Final = ("simulation", "noise", "pipeline")
"""Settings that a plant may bring along, as realism levels do."""


def table_notes(cells: "pd.DataFrame", layout: TableLayout, entries: Entries) -> Iterator[str]:
    """Sentences below a table."""
    pooled = _pooled_fields(cells, layout)
    if pooled:
        yield f"Each number is taken over different settings: {', '.join(pooled)}."
    # Rows whose plant is integrated as the models of methods that simulate are.
    same = int(cells["same_simulator"].eq(True).sum()) if "same_simulator" in cells.columns else 0
    if same:
        yield (
            "Plant and candidate models share step and integrator, or the simulator, in "
            f"{same} of {len(cells)} cells: errors of methods that simulate are too small there."
        )
    if "estimator" in layout.fields and FRAME_DEPENDENT in cells.columns:
        of = cells[~cells[FRAME_DEPENDENT].isin(["", "none"])]
        methods = ", ".join(dict.fromkeys(map(label, of["estimator"])))
        if methods:
            yield f"Depends on the frames of the links that the model file has: {methods}."
    for metric in layout.metrics:
        yield from _names(cells, layout, metric)
        # Reasons for which cells have no value, with the number of cells of each
        column = f"{REASONS}.{metric.name}"
        if column in cells.columns:
            given = cells.loc[~cells[column].isin(["", "none"]), column].value_counts()
            for why, n in given.items():
                yield f"{metric.title}: {n} cells without a value: {why}."
    yield from _missing_repeats(layout, entries)
    # Contents and limits of the intervals of each kind.
    kinds = cells[STD_FROM].unique() if STD_FROM in layout.fields else ()
    yield from (f"{kind}: {INTERVAL_LIMITS[kind]}." for kind in kinds if kind in INTERVAL_LIMITS)
    if layout.effects:
        yield from effect_notes(dict(entries), (layout.rows, layout.columns))


def _pooled_fields(cells: "pd.DataFrame", layout: TableLayout) -> list[str]:
    """Fields that differ between the cells of an entry, "FIELD (COUNT)": its statistic compares
    unlike settings. Settings that plants bring along are not counted beside the plants."""
    swept = [field for field in SWEEPABLE if field in cells.columns and field not in layout.fields]
    counts = {field: _pooled_values(cells, field, layout) for field in swept}
    return [f"{field} ({count})" for field, count in counts.items() if count > 1]


def _pooled_values(cells: "pd.DataFrame", field: str, layout: TableLayout) -> int:
    """Largest number of values of a field in an entry, and for one plant where plants set it."""
    shown = [name for name in layout.fields if name in cells.columns]
    groups = [*shown, *([PLANT] if field in OF_PLANTS else ())]
    keys = [key for key in dict.fromkeys(groups) if key in cells.columns]
    if not keys:
        return int(cells[field].nunique())
    return int(cells.groupby(keys, dropna=False)[field].nunique().max())


def _names(cells: "pd.DataFrame", layout: TableLayout, metric: Metric) -> list[str]:
    """Names behind a count, from the column `<metric>_names`."""
    column = f"{metric.name}_names"
    if column not in cells.columns:
        return []
    named = cells[~cells[column].isin(["", "none"])].to_dict("records")
    rows = ((" / ".join(str(row[field]) for field in layout.fields), row[column]) for row in named)
    return sorted({f"{place}: {metric.title.lower()}: {names}." for place, names in rows})


def _missing_repeats(layout: TableLayout, entries: Entries) -> Iterator[str]:
    """Reason for which metrics of all repeats are missing: there are too few of them."""
    needs = set[str]().union(
        *(metric.needs for metric in layout.metrics if metric.level in OF_REPEATS)
    )
    if needs and any(entry.missing for entry in entries.values() if entry.value is None):
        bound = ", or no noise of the torque and so no bound" if "noise" in needs else ""
        yield f"{ABSENT}: fewer than {REPEATS.fewest} repeats, no noise at all{bound}."


def build_table(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    parameters: "pd.DataFrame | None" = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Table:
    """The table of a [[table]] entry of a suite (see `select_rows` for `select` and `choose`).

    `spec["metrics"]` are a column each; `spec["cells"]["metric"]` is the only one. The
    `parameters` of all cells, by `id`, are for metrics of all repeats together. `metrics` are the
    records of those that may be named. Raises UsageError for unknown keys, fields, metrics and
    statistics, and where no cell is left.
    """
    layout = layout_of(spec, cells, metrics)
    kept = table_fields(layout.fields, (metric.name for metric in layout.metrics))
    chosen = select_rows(cells, spec, choose)
    # Only columns that the table can show are turned into text: rows have hundreds.
    chosen = with_labels(chosen[[name for name in chosen.columns if name in kept]])
    has_baselines = "estimator" in layout.fields and spec.get("baselines", True)
    is_error = any(metric.name == ERROR for metric in layout.metrics)
    shown = with_baselines(chosen) if has_baselines and is_error else chosen
    entries = table_entries(shown, layout, parameters)
    fields = len(layout.columns)
    columns = _ordered(shown, layout.columns, (column[:fields] for _, column in entries))
    if layout.has_metric_columns:  # each of them below every other label
        columns = tuple((*key, metric.name) for key in columns for metric in layout.metrics)
    table = Table(
        name=layout.name,
        title=layout.title,
        metrics=layout.metrics,
        stat=layout.stat,
        interval=layout.interval,
        row_fields=layout.rows,
        column_fields=layout.column_fields,
        rows=_ordered(shown, layout.rows, (row for row, _ in entries)),
        columns=columns,
        entries=entries,
        notes=(
            *table_notes(chosen, layout, entries),
            *captions({*shown["estimator"][len(chosen) :]} if len(shown) > len(chosen) else ()),
        ),
        repeats=int(chosen["repeat"].nunique()) if "repeat" in chosen.columns else 0,
    )
    # A number over several realism levels belongs to none, and is not the best of any.
    return table if _pools_plants(chosen, layout) else with_best(table, spec.get("best", "none"))


def _pools_plants(cells: "pd.DataFrame", layout: TableLayout) -> bool:
    """True where an entry has cells of several plants."""
    if "plant" not in cells.columns or "plant" in layout.fields:
        return False
    fields = [field for field in layout.fields if field in cells.columns]
    plants = cells.groupby(fields, dropna=False)["plant"] if fields else cells["plant"]
    return bool(np.max(plants.nunique()) > 1)


def table_fields(fields: Iterable[str], metrics: Iterable[str]) -> frozenset[str]:
    """Columns of cells that a table of some fields and metrics can show or explain."""
    names = list(metrics)
    more = [text for name in names for text in (f"{name}_names", f"{REASONS}.{name}")]
    always = ["id", "status", "repeat", "same_simulator", FRAME_DEPENDENT]
    if ERROR in names:
        always += ["experiment", *chain.from_iterable(BASELINES.values())]
    return frozenset((*always, *SWEEPABLE, *SETTING, *fields, *names, *more))


def _ordered(cells: "pd.DataFrame", fields: Key, keys: Iterable[Key]) -> tuple[Key, ...]:
    """Distinct keys by first appearance, field by field, so that groups stay together."""
    ranks = [{label(v): i for i, v in enumerate(cells[field].unique())} for field in fields]

    def place(key: Key) -> list[int]:
        return [rank[part] for rank, part in zip(ranks, key, strict=True)]

    return tuple(sorted(dict.fromkeys(keys), key=place))
