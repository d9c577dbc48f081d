"""A table as comma-separated values with full precision, for other programs."""

import csv
import io

from sysid_bench.reporting.tables import METRIC, Table


def to_csv(table: Table) -> str:
    """One line per entry and metric: fields, metric, value, low, high (17 digits where needed),
    counts, marks."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = ["metric", "unit", "stat", "interval", "value", "low", "high", "n", "n_failed"]
    head += ["failures", "missing", "best", "better"]
    # The name of the metric is in the column "metric" in any case.
    fields = [field for field in table.column_fields if field != METRIC]
    writer.writerow([*table.row_fields, *fields, *head])
    for row, column in table.indices:
        entry = table.entry(row, column)
        if entry is None:
            continue
        failures = " ".join(f"{kind}={count}" for kind, count in entry.failures.items())
        metric = table.metric_of(column)
        kind = [metric.name, metric.unit, table.stat, table.interval]
        numbers = [entry.text or entry.value, entry.low, entry.high, entry.n, entry.n_failed]
        marks = [failures, entry.missing, int(entry.best), metric.better or ""]
        writer.writerow([*row, *column[: len(fields)], *kind, *numbers, *marks])
    return out.getvalue()
