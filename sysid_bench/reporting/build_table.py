"""Tables from cells: selection, grouping, statistics, notes."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_bench.evaluation.repeat_statistic import SETTING
from sysid_bench.metrics import METRICS, REASONS
from sysid_bench.reporting.best_entries import with_best
from sysid_bench.reporting.selection import SWEEPABLE, Choose, label, select_rows, with_labels
from sysid_bench.reporting.table_entries import table_entries
from sysid_bench.reporting.table_layout import TableLayout, layout_of
from sysid_bench.reporting.table_notes import table_notes
from sysid_bench.reporting.tables import Key, Table
from sysid_bench.types import Metric

if TYPE_CHECKING:
    import pandas as pd


def build_table(
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
    layout = layout_of(spec, cells, metrics)
    chosen = with_labels(_used(select_rows(cells, spec, choose), layout))
    entries = table_entries(chosen, layout, parameters)
    table = Table(
        name=layout.name,
        title=layout.title,
        metrics=layout.metrics,
        stat=layout.stat,
        interval=layout.interval,
        row_fields=layout.rows,
        column_fields=layout.column_fields,
        rows=_ordered(chosen, layout.rows, (row for row, _ in entries)),
        columns=_columns(chosen, layout, (column for _, column in entries)),
        entries=entries,
        notes=tuple(table_notes(chosen, layout, entries)),
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
    always = ("id", "status", "repeat", "same_simulator")
    return frozenset((*always, *SWEEPABLE, *SETTING, *fields, *names, *more))


def _used(cells: "pd.DataFrame", layout: TableLayout) -> "pd.DataFrame":
    """Cells with the columns alone that a table can show or explain."""
    fields = table_fields(layout.fields, (metric.name for metric in layout.metrics))
    return cells[[name for name in cells.columns if name in fields]]


def _columns(cells: "pd.DataFrame", layout: TableLayout, keys: Iterable[Key]) -> tuple[Key, ...]:
    """Column keys in order; with several metrics, each of them below every other label."""
    fields = len(layout.columns)
    columns = _ordered(cells, layout.columns, (key[:fields] for key in keys))
    if not layout.has_metric_columns:
        return columns
    return tuple((*key, metric.name) for key in columns for metric in layout.metrics)


def _ordered(cells: "pd.DataFrame", fields: Key, keys: Iterable[Key]) -> tuple[Key, ...]:
    """Distinct keys by first appearance, field by field, so that groups stay together."""
    ranks = [{label(v): i for i, v in enumerate(cells[field].unique())} for field in fields]

    def place(key: Key) -> list[int]:
        return [rank[part] for rank, part in zip(ranks, key, strict=True)]

    return tuple(sorted(dict.fromkeys(keys), key=place))
