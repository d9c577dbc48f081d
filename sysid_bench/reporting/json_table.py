"""A table as JSON, for other programs: every number with full precision, every text as it is."""

import json
from dataclasses import asdict
from typing import Any

from sysid_bench.canonical_json import plain
from sysid_bench.reporting.tables import METRIC, Entry, Key, Table


def to_json(table: Table) -> str:
    """An object with name, title, caption, metrics, notes and `entries`: an object each, with its
    labels by field, its metric, and value, low, high (null where there is none), counts, text."""
    found = ((row, column, table.entry(row, column)) for row, column in table.indices)
    content = {
        "name": table.name,
        "title": table.title,
        "caption": table.description,
        "statistic": table.stat,
        "interval": table.interval,
        "metrics": [
            {key: getattr(metric, key) for key in ("name", "title", "unit", "better")}
            for metric in table.metrics
        ],
        "entries": [_entry(table, row, column, entry) for row, column, entry in found if entry],
        "notes": table.notes,
    }
    return json.dumps(plain(content), indent=1, ensure_ascii=False) + "\n"


def _entry(table: Table, row: Key, column: Key, entry: Entry) -> dict[str, Any]:
    fields = [field for field in table.column_fields if field != METRIC]
    labels = dict(zip(table.row_fields, row, strict=True)) | dict(zip(fields, column, strict=False))
    return {**labels, METRIC: table.metric_of(column).name, **asdict(entry)}
