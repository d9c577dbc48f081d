"""A table as comma-separated values with full precision, for other programs."""

import csv
import io

from sysid_bench.reporting.tables import METRIC, Entry, Key, Table

_HEAD = (
    *("metric", "unit", "stat", "interval", "value", "low", "high", "n", "n_failed", "failures"),
    *("missing", "best", "better"),
)


def to_csv(table: Table) -> str:
    """One line per entry and metric: fields, metric, value, low, high (17 digits where needed),
    counts, marks."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    # The name of the metric is in the column "metric" in any case.
    fields = [field for field in table.column_fields if field != METRIC]
    writer.writerow([*table.row_fields, *fields, *_HEAD])
    for row, column in filter(table.entries.__contains__, table.indices):
        entry = table.entries[row, column]
        writer.writerow([*row, *column[: len(fields)], *_values(table, column, entry)])
    return out.getvalue()


def _values(table: Table, column: Key, entry: Entry) -> list[object]:
    """Values below `_HEAD`."""
    metric = table.metric_of(column)
    failures = " ".join(f"{kind}={count}" for kind, count in entry.failures.items())
    kind = [metric.name, metric.unit, table.stat, table.interval]
    numbers = [entry.text or entry.value, entry.low, entry.high, entry.n, entry.n_failed]
    return [*kind, *numbers, failures, entry.missing, int(entry.best), metric.better or ""]
