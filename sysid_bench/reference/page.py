"""A page of the reference: sections and tables that print as Markdown, and the entries in them,
which `sysid-bench help NAME` finds."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from inspect import cleandoc
from typing import Final

from sysid_bench.reporting.terminal import plain_text
from sysid_bench.reporting.writers import table_line

_SPECIAL: Final = re.compile(r"[*_\[\]\\]")
_ENTITIES: Final = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;"})
"""Characters that begin HTML or a cell; a backslash before them is printed by some."""
_CODE: Final = re.compile(r"(`[^`]*`)")
_CODED: Final = re.compile(r"`([^`]+)`")
_INDENTED: Final = re.compile(r"^ {4,}\S", re.MULTILINE)
_FENCED: Final = re.compile(r"```.*?```", re.DOTALL)
_TITLE: Final = 100
"""Most letters of a title."""
_TITLES: Final = ("title", "meaning", "what")
"""Columns of a table that say what its lines are."""


def markdown_text(text: str) -> str:
    """Return a docstring as Markdown: paragraphs; names between backticks and indented lines are
    code, all else prints as it is."""
    parts = cleandoc(text).split("\n\n")
    return "\n\n".join(part if _INDENTED.match(part) else markdown_line(part) for part in parts)


def markdown_line(text: str) -> str:
    """Return text as one line of Markdown; what stands between backticks is code."""
    pieces = _CODE.split(" ".join(text.split()))
    for i in range(0, len(pieces), 2):
        # Even pieces are text, odd ones code, which prints as it is.
        pieces[i] = _SPECIAL.sub(r"\\\g<0>", pieces[i]).translate(_ENTITIES)
    return "".join(pieces)


def code(text: str) -> str:
    """Return text as code; nothing for no text."""
    return f"`{text}`" if text else ""


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


class Table:
    """A table of cells that are Markdown already; it prints nothing without rows."""

    def __init__(self, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        self.header, self.rows = header, [tuple(row) for row in rows]

    def __str__(self) -> str:
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "\n".join(map(table_line, lines)) if self.rows else ""

    def entries(self, page: str, prefix: str) -> Iterator[Entry]:
        """Yield an entry for each line whose first cell is a name, `prefix` before it; options as
        "-o, --out PATH" have two."""
        for row in self.rows:
            cells = dict(zip(self.header, row, strict=True))
            first = _CODED.fullmatch(row[0])
            if first is None:  # the line of a list of sections
                continue
            names = [first[1]]
            if first[1].startswith("-"):
                names = [part.split()[0] for part in first[1].split(", ")]
            # The cell that says what the line is: by its column, else the last one with a text.
            titles = (*map(cells.get, _TITLES), *reversed(row[1:]))
            title = _title(next(filter(None, titles), ""))
            text = "\n".join(f"- {field}: {cell}" for field, cell in cells.items() if cell)
            for name in names:
                yield Entry(page, prefix + name, title, text, is_section=False)


class Section:
    """A page, or a part of one: a heading as "## `name`", then texts, tables and sections."""

    def __init__(self, heading: str, *parts: "str | Table | Section") -> None:
        self.heading, self.parts = heading, parts

    def __str__(self) -> str:
        return f"{self.heading}\n\n{self.text}".rstrip("\n") + ("\n" if self.is_page else "")

    @property
    def text(self) -> str:
        """Text below the heading."""
        return "\n\n".join(filter(None, (str(part).strip("\n") for part in self.parts)))

    @property
    def is_page(self) -> bool:
        """True for a heading of the first level."""
        return self.heading.startswith("# ")

    def entries(self, page: str) -> list[Entry]:
        """Return the entries in the order of the page, each section before its lines."""
        names = {section.name for section in self._sections()}
        found = []
        for section in self._sections():
            prefix = ""
            if not section.is_page:
                title = _title(section._first_paragraph())
                found.append(Entry(page, section.name, title, section.text, is_section=True))
                # The lines of a section whose heading is words have their own names alone.
                prefix = f"{section.name}." if "`" in section.heading else ""
            tables = (part for part in section.parts if isinstance(part, Table))
            lines = (entry for table in tables for entry in table.entries(page, prefix))
            found += [entry for entry in lines if entry.name not in names]  # a key that is a table
        return found

    @property
    def name(self) -> str:
        """The code of the heading without brackets, else its words joined by hyphens."""
        words = self.heading.lstrip("# ")
        coded = _CODED.fullmatch(words)
        return coded[1].strip("[]") if coded else words.lower().replace(" ", "-")

    def _first_paragraph(self) -> str:
        """The first paragraph that is neither a table, a heading nor code."""
        words = [part.strip("\n") for part in _FENCED.sub("", self.text).split("\n\n")]
        plain = (one for one in words if one and not one.startswith(("| ", "#", "    ")))
        return next(plain, "")

    def _sections(self) -> "Iterator[Section]":
        yield self
        for part in self.parts:
            if isinstance(part, Section):
                yield from part._sections()


def _title(markdown: str) -> str:
    flat = plain_text(" ".join(markdown.split()))
    return flat if len(flat) <= _TITLE else f"{flat[: _TITLE - 1].rstrip()}…"
