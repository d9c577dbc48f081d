"""A table as GitHub Markdown."""

import re
from collections.abc import Iterable
from functools import partial

from sysid_bench.reporting.notation import ABSENT, Notation
from sysid_bench.reporting.tables import NO_ENTRY, Entry, Key, Table

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
    return (f"**{number}**" if entry.best else number) + _interval(style, entry)


def _interval(style: Notation, entry: Entry) -> str:
    return rf" \[{', '.join(map(style.text, entry.interval))}\]" if entry.interval else ""
