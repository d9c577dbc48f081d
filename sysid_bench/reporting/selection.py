"""What a table shows: choice of its cells, rows, columns and metrics."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.evaluation.intervals import with_level
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.tables import INTERVALS, METRIC, STATISTICS, Key
from sysid_bench.types import Metric
from sysid_bench.words import BESTS

if TYPE_CHECKING:
    import pandas as pd


Choose = Callable[[str, Mapping[str, Any]], bool]
"""(expression, cell) -> whether the cell meets it."""

_BLOCK: Final = 1000  # cells that are mappings at a time
SWEEPABLE: Final = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "pipeline",
    "estimator",
)  # fmt: skip
"""Fields that make experiments different; a table that pools over one of these has a note."""


def label(value: Any) -> str:
    """A field of a row as text; mappings and lists read as "tau 0.5 %, q 1e-4 rad"."""
    if type(value) is str:
        return value
    if isinstance(value, Mapping):
        return ", ".join(_parts(value)) or "none"
    if isinstance(value, (list, tuple, np.ndarray)):
        return " ".join(map(label, value))
    if isinstance(value, (float, np.floating)):
        # pandas stores a missing text as NaN.
        return "none" if np.isnan(value) else f"{value:g}"
    return "none" if value is None else str(value)


def _parts(value: Mapping[Any, Any]) -> Iterator[str]:
    """ "key value" of each key that is set; the name of what is used stands without its key."""
    for key, part in value.items():
        if part is not None:
            yield label(part) if key == "use" else f"{key} {label(part)}"


def with_labels(cells: "pd.DataFrame") -> "pd.DataFrame":
    """The same cells with text in every field that can make a row or column."""
    columns = [cells[name] for name in cells.columns if _has_labels(cells[name])]
    texts = [str(column.name) for column in columns if set(map(type, column)) != {str}]
    return cells.assign(**{name: list(map(label, cells[name])) for name in texts})


def _has_labels(column: "pd.Series") -> bool:
    if column.name in (*SWEEPABLE, "status"):
        return True
    return column.dtype == object and not _is_boolean(column)


def _is_boolean(column: "pd.Series") -> bool:
    """True where all values of a column are booleans: a metric, not a label."""
    types = set(map(type, column.dropna()))
    return bool(types) and types <= {bool, np.bool_}


def select_rows(
    cells: "pd.DataFrame", spec: Mapping[str, Any], choose: Choose | None
) -> "pd.DataFrame":
    """Cells that `spec["select"]` keeps: a mapping of field to value (or list of values), or an
    expression that `choose(expression, cell)` decides. Raises UsageError where none is left."""
    select = spec.get("select")
    if isinstance(select, str):
        if choose is None:
            raise UsageError(f"Give `choose` to evaluate the expression {select!r}.")
        cells = cells[[choose(select, row) for row in _rows(cells)]]
    elif isinstance(select, Mapping):
        cells = _with_values(cells, select)
    if len(cells) == 0:
        raise UsageError(f"The table {spec.get('name', '')!r} has no cell (select: {select!r}).")
    return cells


def _rows(cells: "pd.DataFrame") -> Iterator[dict[str, Any]]:
    """Yield the cells as mappings, which are made for a block at a time."""
    for start in range(0, len(cells), _BLOCK):
        for row in cells[start : start + _BLOCK].to_dict("records"):
            yield {str(key): value for key, value in row.items()}


def _with_values(cells: "pd.DataFrame", select: Mapping[str, Any]) -> "pd.DataFrame":
    """Cells whose field has the value, or one of the list of values, for every field."""
    for field, value in select.items():
        if field not in cells.columns:
            raise unknown_name("field of the cells", str(field), map(str, cells.columns))
        allowed = set(map(label, value if isinstance(value, list) else [value]))
        cells = cells[[text in allowed for text in map(label, cells[field])]]
    return cells


_SPEC_KEYS: Final = (
    "name",
    "title",
    "rows",
    "columns",
    "cells",
    "metrics",
    "best",
    "select",
    "effects",
)
_CELL_KEYS: Final = ("metric", "stat", "interval")


@dataclass(frozen=True)
class TableLayout:
    """Row and column fields of a table, its metrics and statistic, and whether metrics are
    columns."""

    name: str
    title: str
    rows: Key
    columns: Key
    metrics: tuple[Metric, ...]
    stat: str
    interval: str
    has_metric_columns: bool
    effects: bool = False  # main effects of rows and columns below the table

    @property
    def fields(self) -> Key:
        """Row and column fields of the cells."""
        return self.rows + self.columns

    @property
    def column_fields(self) -> Key:
        """Labels of a column: the fields, and the metric where metrics are columns."""
        return (*self.columns, METRIC) if self.has_metric_columns else self.columns


def layout_of(
    spec: Mapping[str, Any], cells: "pd.DataFrame", metrics: Mapping[str, Metric] = METRICS
) -> TableLayout:
    """The layout that a [[table]] entry describes; `metrics` are the records that it may name.

    Raises UsageError for unknown keys, fields, metrics and statistics.
    """
    where = f"table {spec.get('name', '')!r}"
    names = metric_names(spec)
    _all_known(f"key of {where}", spec, _SPEC_KEYS)
    _all_known(f"key of cells in {where}", spec.get("cells", {}), _CELL_KEYS)
    if not names or not spec.get("rows"):
        raise UsageError(
            f"The {where} has the keys {', '.join(spec)}; "
            "give it rows = [...] and metrics = [...] or cells = { metric = ... }."
        )
    _check_fields(spec, names, cells, metrics, where)
    _check_choices(spec)
    found = (metric_of(name, metrics) for name in names)
    records = tuple(replace(metric, title=with_level(metric.title)) for metric in found)
    wanted = spec.get("cells", {})
    return TableLayout(
        name=str(spec.get("name", names[0])),
        title=str(spec.get("title") or ", ".join(metric.title for metric in records)),
        rows=tuple(spec["rows"]),
        columns=tuple(spec.get("columns", ())),
        metrics=records,
        stat=wanted.get("stat", "median"),
        interval=wanted.get("interval", "none"),
        has_metric_columns=bool(spec.get("metrics")),
        effects=bool(spec.get("effects")),
    )


def metric_names(spec: Mapping[str, Any]) -> tuple[str, ...]:
    """The metrics of a table: `metrics`, or the only one of `cells`."""
    only = spec.get("cells", {}).get("metric")
    return tuple(dict.fromkeys(spec.get("metrics") or filter(None, [only])))


def _check_fields(
    spec: Mapping[str, Any],
    names: Key,
    cells: "pd.DataFrame",
    metrics: Mapping[str, Metric],
    where: str,
) -> None:
    """A metric may be absent from the cells: where every cell failed, no row has one."""
    fields, hint = list(map(str, cells.columns)), f"Named in {where}."
    numeric = [field for field in fields if cells[field].dtype.kind in "bif"]
    wanted = (*spec["rows"], *spec.get("columns", ()), "status")
    _all_known("field of the cells", wanted, fields, hint=hint)
    _all_known("metric of the cells", names, numeric, {*fields, *metrics}, hint)


def _check_choices(spec: Mapping[str, Any]) -> None:
    wanted = spec.get("cells", {})
    _all_known("statistic", [wanted.get("stat", "median")], STATISTICS)
    _all_known("interval", [wanted.get("interval", "none")], INTERVALS)
    _all_known("way to mark the best", [spec.get("best", "none")], BESTS)


def _all_known(
    kind: str,
    given: Iterable[Any],
    known: Iterable[str],
    accepted: Iterable[str] = (),
    hint: str = "",
) -> None:
    """Raise UsageError, which lists the known names, for one that is neither known nor accepted."""
    known, accepted = list(known), list(accepted)
    for name in given:
        if name not in known + accepted:
            raise unknown_name(kind, str(name), known, hint)
