"""Rows become a table: one entry per group of cells, and no failed cell dropped in silence."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.evaluation.repeats import ENOUGH_REPEATS
from sysid_bench.reporting.metrics import METRICS, Metric, metric_of
from sysid_bench.reporting.notation import ABSENT, Notation, notation
from sysid_bench.reporting.repeat_errors import repeat_statistic
from sysid_bench.reporting.statistics import INTERVALS, STATISTICS, interval_of, statistic_of

if TYPE_CHECKING:
    import pandas as pd

Key = tuple[str, ...]
Choose = Callable[[str, Mapping[str, Any]], bool]
BESTS: Final = ("none", "min-bold", "max-bold")
_SPEC_KEYS: Final = ("name", "title", "rows", "columns", "cells", "best", "select")
_CELL_KEYS: Final = ("metric", "stat", "interval")
# What tells experiments apart; a table that pools over one of these says so.
_SWEEPABLE: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "estimator",
)  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """One group of cells. `n` cells gave a value, `failures` counts the others by status,
    `missing` those that are ok but have no value of this metric."""

    value: float | None
    low: float | None
    high: float | None
    n: int
    failures: Mapping[str, int]
    missing: int = 0
    best: bool = False
    text: str = ""  # what cells told in words

    @property
    def n_failed(self) -> int:
        """Cells whose status is not ok."""
        return sum(self.failures.values())

    @property
    def word(self) -> str:
        """What stands in place of a number: a text that cells told, or the most frequent failure;
        empty where there is a number."""
        if self.text:
            return self.text
        if self.value is not None or not self.failures:
            return ""
        return max(self.failures, key=lambda kind: self.failures[kind])

    @property
    def note(self) -> str:
        """The cells that the printed value or word does not tell about; empty where none."""
        told = {self.word} if self.word and not self.missing else set()
        if not set(self.failures) - told and not (self.missing and (self.n or self.failures)):
            return ""
        counts = [f"{number} {kind}" for kind, number in self.failures.items()]
        counts += [f"{self.missing} without a value"] if self.missing else []
        lost = self.n_failed + self.missing
        return f"{lost} of {lost + self.n} cells give no number: {', '.join(counts)}."


@dataclass(frozen=True, eq=False)
class Table:
    """Entries by (row key, column key), in the order of first appearance; a key that never
    occurred has no entry. Keys hold one label per field."""

    name: str
    title: str
    metric: Metric
    stat: str
    interval: str
    row_fields: Key
    column_fields: Key
    rows: tuple[Key, ...]
    columns: tuple[Key, ...]
    entries: Mapping[tuple[Key, Key], Entry]
    notes: tuple[str, ...] = ()
    own_caption: str = ""  # where the columns are no single statistic of the metric

    @property
    def caption(self) -> str:
        """What the numbers are, in one sentence."""
        if self.own_caption:
            return self.own_caption
        if self.metric.words:
            return f"{self.metric.heading}."
        if self.metric.repeated:
            ends = ", with 95 % bootstrap interval" if self.interval != "none" else ""
            return f"{self.metric.heading}: over all repeats and parameters{ends}."
        spread = f" with {INTERVALS[self.interval]}" if self.interval != "none" else ""
        return f"{self.metric.heading}: {STATISTICS[self.stat]}{spread}."

    @cached_property
    def footnotes(self) -> dict[str, str]:
        """A letter for every note that an entry carries."""
        found = (self.entries[key].note for key in self.keys if key in self.entries)
        return {note: _letters(i) for i, note in enumerate(dict.fromkeys(filter(None, found)))}

    @property
    def keys(self) -> list[tuple[Key, Key]]:
        """Every place of the table, row by row."""
        return [(row, column) for row in self.rows for column in self.columns]

    def entry(self, row: Key, column: Key) -> Entry | None:
        """The entry at a place, None where no cell was planned."""
        return self.entries.get((row, column))

    @cached_property
    def notations(self) -> dict[Key, Notation]:
        """How the numbers of each column are printed: alike where only the estimator differs."""
        digits = 0 if self.stat == "count" else self.metric.digits
        values: dict[Key, list[float | None]] = {}
        for (_, column), entry in self.entries.items():
            values.setdefault(self._beside(column), []).append(entry.value)
        shared = {beside: notation(numbers, digits) for beside, numbers in values.items()}
        return {column: shared[self._beside(column)] for column in self.columns}

    def _beside(self, column: Key) -> Key:
        """What columns that are read side by side have in common: all but the estimator."""
        pairs = zip(self.column_fields, column, strict=True)
        return tuple(part for field, part in pairs if field != "estimator")


def make_table(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    parameters: "pd.DataFrame | None" = None,
) -> Table:
    """The table of a [[table]] entry of a suite. `spec["select"]` is a mapping of field to value
    (or list of values), or an expression that `choose(expression, cell)` decides. `parameters` of
    all cells, by `id`, are for metrics of all repeats together.

    Best entries are sought among estimators where these are rows or columns, else within a row.
    Raises UsageError for unknown keys, fields, metrics and statistics, and where no cell is left.
    """
    _check(spec, cells)
    wanted = spec["cells"]
    metric, stat = metric_of(wanted["metric"]), wanted.get("stat", "median")
    interval = wanted.get("interval", "none")
    chosen = with_labels(selected(cells, spec, choose))
    rows, columns = tuple(spec.get("rows", ())), tuple(spec.get("columns", ()))
    judge = partial(_entry, metric=metric.name, stat=stat, interval=interval)
    if metric.repeated:
        judge = partial(_repeated, metric=metric.name, interval=interval, parameters=parameters)
    entries = _entries(chosen, rows, columns, judge)
    table = Table(
        name=str(spec.get("name", metric.name)),
        title=str(spec.get("title") or metric.title),
        metric=metric,
        stat=stat,
        interval=interval,
        row_fields=rows,
        column_fields=columns,
        rows=_ordered(chosen, rows, (key[0] for key in entries)),
        columns=_ordered(chosen, columns, (key[1] for key in entries)),
        entries=entries,
        notes=(
            *_pooling(chosen, rows + columns),
            *_foretold(chosen, metric.name, rows + columns),
            *_untold(metric, entries.values()),
        ),
    )
    return _with_best(table, spec.get("best", "none"))


def label(value: Any) -> str:
    """A field of a row as text; mappings and lists read as "tau 0.5 %, q 1e-4 rad"."""
    if isinstance(value, Mapping):
        parts = [label(v) if k == "use" else f"{k} {label(v)}" for k, v in value.items()
                 if v is not None]  # fmt: skip
        return ", ".join(parts) or "none"
    if isinstance(value, (list, tuple, np.ndarray)):
        return " ".join(label(v) for v in value)
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "none"
    return f"{value:g}" if isinstance(value, (float, np.floating)) else str(value)


def with_labels(cells: "pd.DataFrame") -> "pd.DataFrame":
    """The same cells with text in every field that can make a row or column."""
    texts = [
        name
        for name in cells.columns
        if name in (*_SWEEPABLE, "status")
        or (cells[name].dtype == object and not _verdicts(cells[name]))
    ]
    return cells.assign(**{name: [label(value) for value in cells[name]] for name in texts})


def _verdicts(column: "pd.Series") -> bool:
    """Whether a column tells true or false where it tells anything: a metric, no label."""
    told = column.dropna()
    return len(told) > 0 and all(isinstance(value, (bool, np.bool_)) for value in told)


def _check(spec: Mapping[str, Any], cells: "pd.DataFrame") -> None:
    where = f"table {spec.get('name', '')!r}"
    for key in spec:
        if key not in _SPEC_KEYS:
            raise unknown_name(f"key of {where}", str(key), _SPEC_KEYS)
    wanted = spec.get("cells", {})
    for key in wanted:
        if key not in _CELL_KEYS:
            raise unknown_name(f"key of cells in {where}", str(key), _CELL_KEYS)
    if "metric" not in wanted or not spec.get("rows"):
        raise UsageError(
            f"The {where} has the keys {', '.join(spec)}; "
            "give it rows = [...] and cells = { metric = ... }."
        )
    fields = [str(name) for name in cells.columns]
    for field in (*spec["rows"], *spec.get("columns", ()), "status"):
        if field not in fields:
            raise unknown_name("field of the cells", str(field), fields, f"Asked by {where}.")
    if wanted["metric"] not in fields and wanted["metric"] not in METRICS:
        numeric = [name for name in fields if cells[name].dtype.kind in "bif"]
        raise unknown_name("metric of the cells", wanted["metric"], numeric, f"Asked by {where}.")
    _one_of("statistic", wanted.get("stat", "median"), STATISTICS)
    _one_of("interval", wanted.get("interval", "none"), INTERVALS)
    _one_of("way to mark the best", spec.get("best", "none"), BESTS)


def _one_of(kind: str, name: str, known: Iterable[str]) -> None:
    if name not in (known := list(known)):
        raise unknown_name(kind, name, known)


def selected(
    cells: "pd.DataFrame", spec: Mapping[str, Any], choose: Choose | None
) -> "pd.DataFrame":
    """The cells that `spec["select"]` keeps (see `make_table`)."""
    select = spec.get("select")
    if isinstance(select, str):
        if choose is None:
            raise UsageError(f"Nothing here can read the expression {select!r}: give `choose`.")
        keep = [choose(select, {str(k): v for k, v in row.items()})
                for row in cells.to_dict("records")]  # fmt: skip
        cells = cells[keep]
    for field, value in select.items() if isinstance(select, Mapping) else ():
        if field not in cells.columns:
            raise unknown_name("field of the cells", str(field), map(str, cells.columns))
        allowed = [label(v) for v in (value if isinstance(value, list) else [value])]
        cells = cells[[label(v) in allowed for v in cells[field]]]
    if len(cells) == 0:
        raise UsageError(f"The table {spec.get('name', '')!r} has no cell (select: {select!r}).")
    return cells


def _entries(
    cells: "pd.DataFrame", rows: Key, columns: Key, judge: Callable[["pd.DataFrame"], Entry]
) -> dict[tuple[Key, Key], Entry]:
    fields, entries = [*rows, *columns], {}
    for key, group in cells.groupby(fields, sort=False, dropna=False):
        labels = tuple(label(part) for part in (key if isinstance(key, tuple) else (key,)))
        entries[labels[: len(rows)], labels[len(rows) :]] = judge(group)
    return entries


def _entry(group: "pd.DataFrame", metric: str, stat: str, interval: str) -> Entry:
    ok = group[group["status"] == "ok"]
    # Parquet and JSON hand whole numbers, booleans and None in one column of objects.
    # Where every cell failed, no row has the metric at all.
    told = ok[metric] if metric in ok else [None] * len(ok)
    counts = _failures(group)
    if metric_of(metric).words:
        return _worded([value for value in told if isinstance(value, str)], len(ok), counts)
    values = np.array([_number(value) for value in told], dtype=float)
    repeats = ok["repeat"].to_numpy() if "repeat" in ok else np.arange(len(ok))
    finite = np.isfinite(values)
    values, repeats = values[finite], repeats[finite]
    low, high = interval_of(interval, stat, values, repeats)
    value = statistic_of(stat, values) if len(values) else None
    return Entry(value, low, high, len(values), counts, int((~finite).sum()))


def _failures(group: "pd.DataFrame") -> dict[str, int]:
    failures = group.loc[group["status"] != "ok", "status"].value_counts(sort=False)
    return {str(kind): int(number) for kind, number in failures.items()}


def _repeated(
    group: "pd.DataFrame", metric: str, interval: str, parameters: "pd.DataFrame | None"
) -> Entry:
    """The figure of all repeats of a group, its cells each one repeat of one setting."""
    ok = group[group["status"] == "ok"]
    figure = None if parameters is None else repeat_statistic(metric, ok, parameters)
    if figure is None:
        return Entry(None, None, None, 0, _failures(group), len(ok))
    value, low, high = figure
    if interval == "none":
        return Entry(value, None, None, len(ok), _failures(group))
    return Entry(value, low, high, len(ok), _failures(group))


def _worded(texts: Sequence[str], cells: int, failures: Mapping[str, int]) -> Entry:
    """One text where all cells tell the same, else each with its count."""
    met = Counter(texts)
    text = ", ".join(met if len(met) == 1 else (f"{word} {n}" for word, n in met.most_common()))
    return Entry(None, None, None, len(texts), failures, cells - len(texts), text=text)


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return np.nan


def _ordered(cells: "pd.DataFrame", fields: Key, keys: Iterable[Key]) -> tuple[Key, ...]:
    """Distinct keys by first appearance, field by field, so that groups stay together."""
    ranks = [{label(v): i for i, v in enumerate(cells[field].unique())} for field in fields]
    return tuple(
        sorted(
            dict.fromkeys(keys),
            key=lambda key: [rank[part] for rank, part in zip(ranks, key, strict=True)],
        )
    )


def _pooling(cells: "pd.DataFrame", shown: Sequence[str]) -> tuple[str, ...]:
    hidden = [f for f in _SWEEPABLE if f in cells.columns and f not in shown]
    pooled = [f"{cells[f].nunique()} of {f}" for f in hidden if cells[f].nunique() > 1]
    return (f"Each number pools different settings: {', '.join(pooled)}.",) if pooled else ()


def _foretold(cells: "pd.DataFrame", metric: str, shown: Sequence[str]) -> tuple[str, ...]:
    """Which torques data cannot foretell, by the labels of the table that counts them."""
    if metric != "unpredictable" or "unpredictable_names" not in cells.columns:
        return ()
    named = cells[cells["unpredictable_names"].fillna("") != ""]
    told = {
        (" / ".join(str(row[field]) for field in shown), row["unpredictable_names"])
        for _, row in named.iterrows()
    }
    return tuple(f"{label}: the torques of {names} cannot be foretold." for label, names in
                 sorted(told))  # fmt: skip


def _untold(metric: Metric, entries: Iterable[Entry]) -> tuple[str, ...]:
    if not metric.repeated or not any(e.value is None and e.missing for e in entries):
        return ()
    bound = "" if metric.name == "bias" else ", or no noise of the torque and so no bound"
    return (f"{ABSENT}: fewer than {ENOUGH_REPEATS} repeats, no noise at all{bound}.",)


def _with_best(table: Table, best: str) -> Table:
    if best == "none":
        return table
    sign = 1 if best == "min-bold" else -1
    groups: dict[Key, list[tuple[Key, Key]]] = {}
    for key in table.entries:
        groups.setdefault(_competition(table, key), []).append(key)
    winners = {key for keys in groups.values() for key in _winners(table, keys, sign)}
    marked = {key: replace(entry, best=key in winners) for key, entry in table.entries.items()}
    return replace(table, entries=marked)


def _competition(table: Table, key: tuple[Key, Key]) -> Key:
    """What is equal for entries that compete: all but the estimator, or the row."""
    fields = table.row_fields + table.column_fields
    if "estimator" not in fields:
        return key[0]
    return tuple(part for f, part in zip(fields, sum(key, ()), strict=True) if f != "estimator")


def _winners(table: Table, keys: list[tuple[Key, Key]], sign: int) -> list[tuple[Key, Key]]:
    values = {key: v for key in keys if (v := table.entries[key].value) is not None}
    floor = table.metric.floor
    if len(keys) < 2 or not values or all(abs(v) < floor for v in values.values()):
        return []
    values = {key: max(v, floor) if v >= 0 else min(v, -floor) for key, v in values.items()}
    first = min(values, key=lambda key: sign * values[key])
    # Numbers that print alike are equal to the reader: all of them are best.
    text = table.notations[first[1]].text
    return [key for key, value in values.items() if text(value) == text(values[first])]


def _letters(i: int) -> str:
    return (_letters(i // 26 - 1) if i >= 26 else "") + ascii_lowercase[i % 26]
