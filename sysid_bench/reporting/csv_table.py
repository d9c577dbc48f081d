"""A table as comma-separated values with full precision, for other programs."""

from sysid_bench.csv_text import csv_text
from sysid_bench.reporting.tables import METRIC, Entry, Key, Table

_HEAD = (
    *("metric", "unit", "stat", "interval", "value", "low", "high", "n", "n_failed", "failures"),
    *("missing", "best", "better"),
)


def to_csv(table: Table) -> str:
    """One line per entry and metric: fields, metric, value, low, high (17 digits where needed),
    counts, marks."""
    # The name of the metric is in the column "metric" in any case.
    fields = [field for field in table.column_fields if field != METRIC]
    entries = ((row, column, table.entries.get((row, column))) for row, column in table.indices)
    lines = (
        [*row, *column[: len(fields)], *_values(table, column, entry)]
        for row, column, entry in entries
        if entry is not None
    )
    return csv_text([[*table.row_fields, *fields, *_HEAD], *lines])


def _values(table: Table, column: Key, entry: Entry) -> list[object]:
    """Values below `_HEAD`."""
    metric = table.metric_of(column)
    failures = " ".join(f"{kind}={count}" for kind, count in entry.failures.items())
    kind = [metric.name, metric.unit, table.stat, table.interval]
    numbers = [entry.text or entry.value, entry.low, entry.high, entry.n, entry.n_failed]
    return [*kind, *numbers, failures, entry.missing, int(entry.best), metric.better or ""]
