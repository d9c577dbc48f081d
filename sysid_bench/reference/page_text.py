"""Parts of a page of the reference: text of docstrings and tables, as Markdown."""

import re
from collections.abc import Iterable, Sequence
from inspect import cleandoc
from typing import Final

from sysid_bench.reporting.writers import table_line

_SPECIAL: Final = re.compile(r"[*_\[\]\\]")
_ENTITIES: Final = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;"})
"""Characters that begin HTML or a cell; a backslash before them is printed by some."""

_CODE: Final = re.compile(r"(`[^`]*`)")
_INDENTED: Final = re.compile(r"^ {4,}\S", re.MULTILINE)


def markdown_text(text: str) -> str:
    """Return a docstring as Markdown: paragraphs; names between backticks and indented lines are
    code, all else prints as it is."""
    parts = cleandoc(text).split("\n\n")
    return "\n\n".join(part if _INDENTED.match(part) else markdown_line(part) for part in parts)


def markdown_line(text: str) -> str:
    """Return text as one line of Markdown; what stands between backticks is code."""
    flat = " ".join(text.split())
    pieces = _CODE.split(flat)
    return "".join(x if number % 2 else _as_is(x) for number, x in enumerate(pieces))


def _as_is(text: str) -> str:
    """Text that Markdown prints as it is."""
    return _SPECIAL.sub(r"\\\g<0>", text).translate(_ENTITIES)


def code(text: str) -> str:
    """Return text as code; nothing for no text."""
    return f"`{text}`" if text else ""


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a pipe table of cells that are Markdown already."""
    lines = [table_line(header), table_line(["---"] * len(header))]
    return "\n".join([*lines, *map(table_line, rows)])


def page(*parts: str) -> str:
    """Return parts as one page, empty ones left out."""
    return "\n\n".join(filter(None, parts)) + "\n"
