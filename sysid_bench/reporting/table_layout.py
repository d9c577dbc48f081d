"""Layout of a table: rows, columns, metrics and statistic of a [[table]] entry of a suite."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.statistic import INTERVALS, STATISTICS
from sysid_bench.reporting.tables import METRIC, Key
from sysid_bench.types import Metric
from sysid_bench.words import BESTS

if TYPE_CHECKING:
    import pandas as pd

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
    _check_keys(spec, names, where)
    _check_fields(spec, names, cells, metrics, where)
    _check_choices(spec)
    records = tuple(metric_of(name, metrics) for name in names)
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


def _check_keys(spec: Mapping[str, Any], names: Key, where: str) -> None:
    _all_known(f"key of {where}", spec, _SPEC_KEYS)
    _all_known(f"key of cells in {where}", spec.get("cells", {}), _CELL_KEYS)
    if not names or not spec.get("rows"):
        raise UsageError(
            f"The {where} has the keys {', '.join(spec)}; "
            "give it rows = [...] and metrics = [...] or cells = { metric = ... }."
        )


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
