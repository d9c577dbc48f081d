"""A table as comma-separated values with full precision, for other programs."""

import csv
import io

from sysid_bench.reporting.tables import Table


def to_csv(table: Table) -> str:
    """One line per entry: its fields, then value, low, high (17 digits where needed), counts."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = ["metric", "unit", "stat", "interval", "value", "low", "high", "n", "n_failed"]
    writer.writerow([*table.row_fields, *table.column_fields, *head, "failures", "missing", "best"])
    for row, column in table.keys:
        entry = table.entry(row, column)
        if entry is None:
            continue
        failures = " ".join(f"{kind}={count}" for kind, count in entry.failures.items())
        what = [table.metric.name, table.metric.unit, table.stat, table.interval]
        numbers = [entry.text or entry.value, entry.low, entry.high, entry.n, entry.n_failed]
        writer.writerow([*row, *column, *what, *numbers, failures, entry.missing, int(entry.best)])
    return out.getvalue()
