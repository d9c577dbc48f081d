"""A table as Markdown, CSV and JSON."""

import json
import re
from collections.abc import Iterable
from dataclasses import asdict
from functools import partial
from typing import Any

from sysid_bench.canonical_json import plain
from sysid_bench.csv_text import csv_text
from sysid_bench.reporting.tables import ABSENT, METRIC, NO_ENTRY, Entry, Key, Notation, Table

_SPECIAL = re.compile(r"([\\|<>*`\[\]&])")
# An underscore within a word is plain text in Markdown; at its edge it starts an emphasis.
_LOOSE_UNDERSCORE = re.compile(r"(?<![^\W_])_|_(?![^\W_])")


def to_markdown(table: Table) -> str:
    """Title, caption, a pipe table and its notes; failures stand as words."""
    header = map(markdown_text, [*table.row_fields, *map(table.column_label, table.columns)])
    sides = ["---" if table.metric_of(column).text else "---:" for column in table.columns]
    lines = [table_line(header), table_line(["---"] * len(table.row_fields) + sides)]
    for row in table.rows:
        numbers = map(partial(_cell, table, row), table.columns)
        lines.append(table_line([*map(markdown_text, row), *numbers]))
    parts = [
        f"**{markdown_text(table.title)}**",
        markdown_text(table.description),
        "\n".join(lines),
    ]
    parts += [f"({mark}) {markdown_text(note)}" for note, mark in table.note_labels.items()]
    return "\n\n".join([*parts, *map(markdown_text, table.notes)]) + "\n"


def markdown_text(text: str) -> str:
    """Any text as one line of Markdown that prints as it is."""
    flat = " ".join(str(text).split())
    return _LOOSE_UNDERSCORE.sub(r"\\_", _SPECIAL.sub(r"\\\1", flat))


def table_line(parts: Iterable[str]) -> str:
    """A line of a pipe table."""
    return f"| {' | '.join(parts)} |"


def _cell(table: Table, row: Key, column: Key) -> str:
    entry = table.entry(row, column) or NO_ENTRY
    mark = f" ({table.note_labels[entry.note]})" if entry.note else ""
    return _number(table.column_notation[column], entry) + mark


def _number(style: Notation, entry: Entry) -> str:
    """A number and its interval, or the words instead of it."""
    if entry.value is None:
        return markdown_text(entry.label) or ABSENT
    number = style.text(entry.value)
    ends = rf" \[{', '.join(map(style.text, entry.interval))}\]" if entry.interval else ""
    return (f"**{number}**" if entry.best else number) + ends


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
    lines: list[list[object]] = [[*table.row_fields, *fields, *_HEAD]]
    for row, column, entry in entries:
        if entry is not None:
            metric = table.metric_of(column)
            failures = " ".join(f"{kind}={count}" for kind, count in entry.failures.items())
            kind = [metric.name, metric.unit, table.stat, table.interval]
            numbers = [entry.text or entry.value, entry.low, entry.high, entry.n, entry.n_failed]
            marks = [failures, entry.missing, int(entry.best), metric.better or ""]
            lines.append([*row, *column[: len(fields)], *kind, *numbers, *marks])
    return csv_text(lines)


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
