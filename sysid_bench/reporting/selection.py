"""Contents of a table: choice of its cells, rows, columns and metrics."""

from collections.abc import Callable, Iterable, Mapping
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
        # The name of what is used stands without its key.
        parts = [(key, label(part)) for key, part in value.items() if part is not None]
        return ", ".join(text if key == "use" else f"{key} {text}" for key, text in parts) or "none"
    if isinstance(value, (list, tuple, np.ndarray)):
        return " ".join(map(label, value))
    if isinstance(value, (float, np.floating)):
        # pandas stores a missing text as NaN.
        return "none" if np.isnan(value) else f"{value:g}"
    return "none" if value is None else str(value)


def with_labels(cells: "pd.DataFrame") -> "pd.DataFrame":
    """The same cells with text in every field that can make a row or column."""
    texts = []
    for name in cells.columns:
        types = set(map(type, cells[name].dropna()))
        # A column of booleans is a metric, not a label.
        is_boolean = bool(types) and types <= {bool, np.bool_}
        is_label = name in (*SWEEPABLE, "status") or (
            cells[name].dtype == object and not is_boolean
        )
        if is_label and set(map(type, cells[name])) != {str}:
            texts.append(str(name))
    return cells.assign(**{name: list(map(label, cells[name])) for name in texts})


def select_rows(
    cells: "pd.DataFrame", spec: Mapping[str, Any], choose: Choose | None
) -> "pd.DataFrame":
    """Cells that `spec["select"]` keeps: a mapping of field to value (or list of values), or an
    expression that `choose(expression, cell)` decides. Raises UsageError where none is left."""
    select = spec.get("select")
    if isinstance(select, str):
        if choose is None:
            raise UsageError(f"Give `choose` to evaluate the expression {select!r}.")
        kept: list[bool] = []
        for start in range(0, len(cells), _BLOCK):
            for row in cells[start : start + _BLOCK].to_dict("records"):
                kept.append(choose(select, {str(key): value for key, value in row.items()}))
        cells = cells[kept]
    elif isinstance(select, Mapping):
        for field, value in select.items():
            if field not in cells.columns:
                raise unknown_name("field of the cells", str(field), map(str, cells.columns))
            # Compared as text, as tables show it: 1 and 1.0 are one value, and so are mappings in
            # rows of JSON and Parquet.
            allowed = set(map(label, value if isinstance(value, list) else [value]))
            cells = cells[[text in allowed for text in map(label, cells[field])]]
    if len(cells) == 0:
        raise UsageError(f"The table {spec.get('name', '')!r} has no cell (select: {select!r}).")
    return cells


_SPEC_KEYS: Final = (
    *(
        "name",
        "title",
        "rows",
        "columns",
        "cells",
        "metrics",
        "best",
        "select",
        "effects",
        "baselines",
    ),
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
    fields, hint = list(map(str, cells.columns)), f"Named in {where}."
    numeric = [field for field in fields if cells[field].dtype.kind in "bif"]
    used = (*spec["rows"], *spec.get("columns", ()), "status")
    _all_known("field of the cells", used, fields, hint=hint)
    # A metric may be absent from the cells: where every cell failed, no row has one.
    _all_known("metric of the cells", names, numeric, {*fields, *metrics}, hint)
    wanted = spec.get("cells", {})
    _all_known("statistic", [wanted.get("stat", "median")], STATISTICS)
    _all_known("interval", [wanted.get("interval", "none")], INTERVALS)
    _all_known("way to mark the best", [spec.get("best", "none")], BESTS)
    found = (metric_of(name, metrics) for name in names)
    records = tuple(replace(metric, title=with_level(metric.title)) for metric in found)
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
