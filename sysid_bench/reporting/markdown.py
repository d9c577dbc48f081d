"""A table as GitHub Markdown."""

import re

from sysid_bench.reporting.notation import ABSENT
from sysid_bench.reporting.tables import Entry, Key, Table

_SPECIAL = re.compile(r"([\\|<>*`\[\]&])")
# An underscore within a word is plain text in Markdown; at its edge it starts an emphasis.
_LOOSE_UNDERSCORE = re.compile(r"(?<![^\W_])_|_(?![^\W_])")


def to_markdown(table: Table) -> str:
    """Title, caption, a pipe table and its notes; failures stand as words."""
    header = [*table.row_fields, *map(table.column_label, table.columns)]
    lines = [_line([escape(name) for name in header])]
    sides = ["---" if table.metric_of(column).text else "---:" for column in table.columns]
    lines.append(_line(["---"] * len(table.row_fields) + sides))
    for row in table.rows:
        numbers = [_cell(table, column, table.entry(row, column)) for column in table.columns]
        lines.append(_line([*map(escape, row), *numbers]))
    parts = [f"**{escape(table.title)}**", escape(table.caption), "\n".join(lines)]
    parts += [f"({mark}) {escape(note)}" for note, mark in table.note_labels.items()]
    return "\n\n".join([*parts, *map(escape, table.notes)]) + "\n"


def escape(text: str) -> str:
    """Any text as one line of Markdown that prints as it is."""
    flat = " ".join(str(text).split())
    return _LOOSE_UNDERSCORE.sub(r"\\_", _SPECIAL.sub(r"\\\1", flat))


def _line(parts: list[str]) -> str:
    return f"| {' | '.join(parts)} |"


def _cell(table: Table, column: Key, entry: Entry | None) -> str:
    if entry is None:
        return ABSENT
    mark = f" ({table.note_labels[entry.note]})" if entry.note else ""
    if entry.value is None:
        return (escape(entry.label) or ABSENT) + mark
    text = table.column_notation[column].text
    value = f"**{text(entry.value)}**" if entry.best else text(entry.value)
    if entry.low is not None and entry.high is not None:
        value += rf" \[{text(entry.low)}, {text(entry.high)}\]"
    return value + mark
