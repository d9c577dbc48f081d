"""Entries of a page of the reference: its sections, and the lines of its tables, with their names.

A page is Markdown that this package makes: sections are headed by a name in code, and so is each
line of a table that describes one thing.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from sysid_bench.reporting.terminal import plain_text, table_cells

_HEADING: Final = re.compile(r"(##+) (.*)")
_CODED: Final = re.compile(r"\[?`([^`]+)`\]?(?:\(#[^)]*\))?")
_ROW: Final = "| "
_FENCE: Final = "```"
_TITLE: Final = 100
"""Most letters of a title."""
_TITLES: Final = ("title", "meaning", "what")
"""Columns of a table that say what its lines are."""


@dataclass(frozen=True)
class Entry:
    """Something with a name on a page: "run.memory" on "suite". `text` is Markdown, `title` the
    beginning of its words. `is_section`: a section of its own, else a line of a table."""

    page: str
    name: str
    title: str
    text: str
    is_section: bool

    @property
    def name_on_page(self) -> str:
        """Name that no other page has."""
        return f"{self.page}.{self.name}"

    @property
    def words(self) -> tuple[str, ...]:
        """Names by which the entry is found: "run.memory" and "memory"."""
        return tuple(dict.fromkeys((self.name_on_page, self.name, self.name.rpartition(".")[2])))


@dataclass(frozen=True)
class _Section:
    name: str
    prefix: str  # of the names of its lines; empty where the heading is words
    lines: tuple[str, ...]  # up to the next section of its level


def entries_of(page: str, text: str) -> list[Entry]:
    """Return the entries of a page in their order, each section before its lines."""
    found: list[Entry] = []
    sections = list(_sections(text.splitlines()))
    names = {section.name for section in sections}
    for section in sections:
        if section.name:
            found.append(_section_entry(page, section))
        # A key that is a table has a section.
        found += [entry for entry in _row_entries(page, section) if entry.name not in names]
    return found


def _sections(lines: Sequence[str]) -> Iterator[_Section]:
    """The part before the first heading, then each section with what it contains."""
    heads = list(_heads(lines))
    first = heads[0][0] if heads else len(lines)
    yield _Section("", "", tuple(lines[:first]))
    for i, (start, level, heading) in enumerate(heads):
        after = (line for line, other, _ in heads[i + 1 :] if other <= level)
        coded = _CODED.fullmatch(heading)
        name = coded[1].strip("[]") if coded else heading.lower().replace(" ", "-")
        prefix = f"{name}." if coded else ""
        yield _Section(name, prefix, tuple(lines[start : next(after, len(lines))]))


def _heads(lines: Sequence[str]) -> Iterator[tuple[int, int, str]]:
    """(line, level, heading) of each heading below the title, outside of code."""
    is_code = False
    for number, line in enumerate(lines):
        is_code ^= line.startswith(_FENCE)
        match = None if is_code else _HEADING.fullmatch(line)
        if match:
            yield number, len(match[1]), match[2]


def _section_entry(page: str, section: _Section) -> Entry:
    text = "\n".join(section.lines[1:]).strip()
    return Entry(page, section.name, _title(_words(section.lines[1:])), text, is_section=True)


def _words(lines: Sequence[str]) -> str:
    """First paragraph that is neither a table nor code."""
    text = "\n".join(lines)
    for part in re.sub(r"```.*?```", "", text, flags=re.DOTALL).split("\n\n"):
        if part.strip() and not part.lstrip("\n").startswith((_ROW, "#", "    ")):
            return part
    return ""


def _row_entries(page: str, section: _Section) -> Iterator[Entry]:
    """Entries of the lines of the tables of a section, without those of the sections within it."""
    inner = (i for i, line in enumerate(section.lines) if i and _HEADING.fullmatch(line))
    lines = section.lines[: next(inner, len(section.lines))]
    table: list[list[str]] = []
    for line in lines:
        table = [*table, table_cells(line)] if line.startswith(_ROW) else []
        if len(table) > 2:
            yield from _row(page, section, table[0], table[-1])


def _row(page: str, section: _Section, head: Sequence[str], row: Sequence[str]) -> Iterator[Entry]:
    first, *others = row
    coded = _CODED.fullmatch(first)
    if coded is None or "](#" in first:  # the line of a list of sections
        return
    title = _title(_row_title(dict(zip(head[1:], others, strict=True))))
    pairs = zip(head, row, strict=True)
    text = "\n".join(f"- {field}: {cell}" for field, cell in pairs if cell)
    for name in _names(coded[1]):
        yield Entry(page, section.prefix + name, title, text, is_section=False)


def _row_title(cells: Mapping[str, str]) -> str:
    """The cell of a line that says what it is: by its field, else the last that is not empty."""
    titles = (*map(cells.get, _TITLES), *reversed([*cells.values()]))
    return next(filter(None, titles), "")


def _names(code: str) -> list[str]:
    """Names in the first cell of a line: options as "-o, --out PATH" have two."""
    if not code.startswith("-"):
        return [code]
    return [part.split()[0] for part in code.split(", ")]


def _title(markdown: str) -> str:
    flat = plain_text(" ".join(markdown.split()))
    return flat if len(flat) <= _TITLE else f"{flat[: _TITLE - 1].rstrip()}…"
