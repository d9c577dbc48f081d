"""Tables from cells: grouping, statistics, notes."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.evaluation.repeat_statistic import ENOUGH_REPEATS
from sysid_bench.metrics import METRICS, REASONS, metric_of
from sysid_bench.reporting.best_entries import with_best
from sysid_bench.reporting.notation import ABSENT
from sysid_bench.reporting.repeat_errors import repeat_statistic
from sysid_bench.reporting.selection import SWEEPABLE, Choose, label, selected, with_labels
from sysid_bench.reporting.statistic import INTERVALS, STATISTICS, interval_of, statistic_of
from sysid_bench.reporting.tables import METRIC, Entry, Key, Table
from sysid_bench.types import Metric
from sysid_bench.vocabulary import BESTS

if TYPE_CHECKING:
    import pandas as pd

_SPEC_KEYS: Final = ("name", "title", "rows", "columns", "cells", "metrics", "best", "select")
_CELL_KEYS: Final = ("metric", "stat", "interval")
Entries = dict[tuple[Key, Key], Entry]


@dataclass(frozen=True)
class _Layout:
    """Row and column fields of a table, its statistic, and whether metrics are columns."""

    rows: Key
    columns: Key
    stat: str
    interval: str
    has_several: bool

    @classmethod
    def of(cls, spec: Mapping[str, Any]) -> "_Layout":
        wanted = spec.get("cells", {})
        return cls(
            tuple(spec.get("rows", ())),
            tuple(spec.get("columns", ())),
            wanted.get("stat", "median"),
            wanted.get("interval", "none"),
            bool(spec.get("metrics")),
        )


def make_table(
    cells: "pd.DataFrame",
    spec: Mapping[str, Any],
    choose: Choose | None = None,
    parameters: "pd.DataFrame | None" = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Table:
    """The table of a [[table]] entry of a suite (see `selected` for `select` and `choose`).

    `spec["metrics"]` are a column each; `spec["cells"]["metric"]` is the only one. The
    `parameters` of all cells, by `id`, are for metrics of all repeats together. `metrics` are the
    records of those that may be named. Raises UsageError for unknown keys, fields, metrics and
    statistics, and where no cell is left.
    """
    names, layout = _metric_names(spec), _Layout.of(spec)
    _check(spec, names, cells, metrics)
    records = tuple(metric_of(name, metrics) for name in names)
    chosen = with_labels(selected(cells, spec, choose))
    entries: Entries = {}
    for metric in records:
        entries |= _entries(chosen, layout, metric, parameters)
    shown = layout.rows + layout.columns
    n = len(layout.columns)
    columns = _ordered(chosen, layout.columns, (key[1][:n] for key in entries))
    if layout.has_several:
        columns = tuple((*key, name) for key in columns for name in names)
    table = Table(
        name=str(spec.get("name", records[0].name)),
        title=str(spec.get("title") or ", ".join(metric.title for metric in records)),
        metrics=records,
        stat=layout.stat,
        interval=layout.interval,
        row_fields=layout.rows,
        column_fields=(*layout.columns, METRIC) if layout.has_several else layout.columns,
        rows=_ordered(chosen, layout.rows, (key[0] for key in entries)),
        columns=columns,
        entries=entries,
        notes=(
            *_pooling(chosen, shown),
            *(note for metric in records for note in _notes(chosen, metric, shown)),
            *_too_few(records, entries),
        ),
    )
    return with_best(table, spec.get("best", "none"))


def _metric_names(spec: Mapping[str, Any]) -> tuple[str, ...]:
    """The metrics of a table: `metrics`, or the only one of `cells`."""
    if spec.get("metrics"):
        return tuple(dict.fromkeys(spec["metrics"]))
    metric = spec.get("cells", {}).get("metric")
    return () if metric is None else (metric,)


def _check(
    spec: Mapping[str, Any],
    names: Sequence[str],
    cells: "pd.DataFrame",
    metrics: Mapping[str, Metric],
) -> None:
    where = f"table {spec.get('name', '')!r}"
    wanted = spec.get("cells", {})
    _known_keys(f"key of {where}", spec, _SPEC_KEYS)
    _known_keys(f"key of cells in {where}", wanted, _CELL_KEYS)
    if not names or not spec.get("rows"):
        raise UsageError(
            f"The {where} has the keys {', '.join(spec)}; "
            "give it rows = [...] and metrics = [...] or cells = { metric = ... }."
        )
    fields = [str(name) for name in cells.columns]
    for field in (*spec["rows"], *spec.get("columns", ()), "status"):
        if field not in fields:
            raise unknown_name("field of the cells", str(field), fields, f"Named in {where}.")
    for name in names:
        if name not in fields and name not in metrics:
            numeric = [field for field in fields if cells[field].dtype.kind in "bif"]
            raise unknown_name("metric of the cells", name, numeric, f"Named in {where}.")
    _one_of("statistic", wanted.get("stat", "median"), STATISTICS)
    _one_of("interval", wanted.get("interval", "none"), INTERVALS)
    _one_of("way to mark the best", spec.get("best", "none"), BESTS)


def _known_keys(kind: str, given: Iterable[str], known: Sequence[str]) -> None:
    for key in given:
        if key not in known:
            raise unknown_name(kind, str(key), known)


def _one_of(kind: str, name: str, known: Iterable[str]) -> None:
    if name not in (known := list(known)):
        raise unknown_name(kind, name, known)


def _entries(
    cells: "pd.DataFrame", layout: _Layout, metric: Metric, parameters: "pd.DataFrame | None"
) -> Entries:
    """Entries of one metric; its name ends the column key where there are several."""
    judge = partial(_entry, metric=metric, stat=layout.stat, interval=layout.interval)
    if metric.level == "repeats":
        judge = partial(_repeated, metric=metric, interval=layout.interval, parameters=parameters)
    name = (metric.name,) if layout.has_several else ()
    n, entries = len(layout.rows), {}
    for key, group in cells.groupby([*layout.rows, *layout.columns], sort=False, dropna=False):
        labels = tuple(label(part) for part in (key if isinstance(key, tuple) else (key,)))
        entries[labels[:n], labels[n:] + name] = judge(group)
    return entries


def _entry(group: "pd.DataFrame", metric: Metric, stat: str, interval: str) -> Entry:
    ok = group[group["status"] == "ok"]
    # Parquet and JSON hand whole numbers, booleans and None in one column of objects.
    # Where every cell failed, no row has the metric at all.
    given = ok[metric.name] if metric.name in ok else [None] * len(ok)
    counts = _failures(group)
    if metric.text:
        return _of_texts([value for value in given if isinstance(value, str)], len(ok), counts)
    values = np.array([_number(value) for value in given], dtype=float)
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
    group: "pd.DataFrame", metric: Metric, interval: str, parameters: "pd.DataFrame | None"
) -> Entry:
    """The figure of all repeats of a group, its cells each one repeat of one setting."""
    ok = group[group["status"] == "ok"]
    figure = None if parameters is None else repeat_statistic(metric.name, ok, parameters)
    if figure is None:
        return Entry(None, None, None, 0, _failures(group), len(ok))
    value, low, high = figure
    if interval == "none":
        return Entry(value, None, None, len(ok), _failures(group))
    return Entry(value, low, high, len(ok), _failures(group))


def _of_texts(texts: Sequence[str], cells: int, failures: Mapping[str, int]) -> Entry:
    """One text where all cells have the same, else each with its count."""
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
    hidden = [f for f in SWEEPABLE if f in cells.columns and f not in shown]
    pooled = [f"{cells[f].nunique()} of {f}" for f in hidden if cells[f].nunique() > 1]
    return (f"Each number pools different settings: {', '.join(pooled)}.",) if pooled else ()


def _notes(cells: "pd.DataFrame", metric: Metric, shown: Sequence[str]) -> Iterator[str]:
    """Names behind a count (the column `<metric>_names`), and reasons of missing values."""
    if f"{metric.name}_names" in cells.columns:
        named = cells[~cells[f"{metric.name}_names"].isin(["", "none"])]
        yield from sorted(
            {
                f"{' / '.join(str(row[field]) for field in shown)}: "
                f"{metric.title.lower()}: {row[f'{metric.name}_names']}."
                for _, row in named.iterrows()
            }
        )
    reasons = f"{REASONS}.{metric.name}"
    if reasons in cells.columns:
        given = cells.loc[~cells[reasons].isin(["", "none"]), reasons].value_counts()
        yield from (f"{metric.title}: {n} cells without a value: {why}." for why, n in
                    given.items())  # fmt: skip


def _too_few(metrics: Iterable[Metric], entries: Entries) -> tuple[str, ...]:
    """Reason why a metric of all repeats is missing."""
    repeated = [metric for metric in metrics if metric.level == "repeats"]
    if not repeated or not any(e.value is None and e.missing for e in entries.values()):
        return ()
    needs_bound = any("noise" in metric.needs for metric in repeated)
    bound = ", or no noise of the torque and so no bound" if needs_bound else ""
    return (f"{ABSENT}: fewer than {ENOUGH_REPEATS} repeats, no noise at all{bound}.",)
