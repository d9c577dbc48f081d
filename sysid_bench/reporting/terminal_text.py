"""Markdown of tables and of the reference as text for a terminal."""

import re
from collections.abc import Iterator, Sequence
from html import unescape
from itertools import chain, groupby
from textwrap import wrap
from typing import Final

from sysid_bench.reporting.terminal_table import table_lines

WIDEST: Final = 100
"""Letters of the lines of a paragraph; tables take the whole width."""
BEST: Final = "*"
"""Mark of the best number, which is bold in Markdown."""

_CODE: Final = re.compile(r"`([^`]*)`")
_ESCAPED: Final = re.compile(r"\\([\\|<>*_`\[\]&])")
_BOLD: Final = re.compile(r"(?<!\\)\*\*(.+?)(?<!\\)\*\*")
_LINK: Final = re.compile(r"(?<!\\)\[((?:[^\]\\]|\\.)*)\]\([^)\s]*\)")
_CELL: Final = re.compile(r"(?:`[^`]*`|\\.|[^|])*")
_HEADING: Final = re.compile(r"(#+) (.*)")
_RULES: Final = {1: "═", 2: "─"}
_RULE: Final = "\n| ---"
_FENCE: Final = "```"


def terminal_text(markdown: str, width: int) -> str:
    """Return Markdown as plain text of at most `width` letters a line, as far as words allow.

    Tables are drawn with aligned columns; the best number of a table carries an asterisk. Code and
    indented lines stay as they are.
    """
    return "\n\n".join(_block(lines, width) for lines in _blocks(markdown)) + "\n"


def terminal_tables(text: str, width: int) -> str:
    """Return text with its pipe tables drawn, and all other lines as they print, never joined or
    wrapped: they may be paths and commands. A text without tables is not Markdown, and stays."""
    if _RULE not in text:
        return text
    parts = []
    for is_table, lines in groupby(text.splitlines(), lambda line: line.startswith("| ")):
        found = list(lines)
        if is_table and len(found) > 1:
            parts.append(_table(found, width))
        else:
            parts += [line[: len(line) - len(line.lstrip())] + plain_text(line) for line in found]
    return "\n".join(parts)


def _blocks(markdown: str) -> Iterator[list[str]]:
    """Lines that stand together; a fence keeps its empty lines."""
    block: list[str] = []
    is_code = False
    for line in markdown.splitlines():
        is_code ^= line.startswith(_FENCE)
        if line.strip() or is_code:
            block.append(line)
        elif block:
            yield block
            block = []
    if block:
        yield block


def _block(lines: Sequence[str], width: int) -> str:
    first = lines[0]
    if first.startswith(_FENCE):
        return _code(lines)
    if first.startswith("    "):
        return "\n".join(lines)
    if first.startswith("| ") and len(lines) > 1:
        return _table(lines, width)
    heading = _HEADING.fullmatch(first)
    if heading and len(lines) == 1:
        return _heading(len(heading[1]), plain_text(heading[2]))
    return _paragraph(lines, min(width, WIDEST))


def _heading(level: int, text: str) -> str:
    return f"{text}\n{_RULES[level] * len(text)}" if level in _RULES else text


def _code(lines: Sequence[str]) -> str:
    return "\n".join(f"    {line}" for line in lines if not line.startswith(_FENCE))


def _paragraph(lines: Sequence[str], width: int) -> str:
    """Wrapped text; items of a list begin with a dash."""
    items = [""]
    for line in lines:
        if line.startswith("- "):
            items.append(line)
        else:
            items[-1] += f" {line.strip()}"
    return "\n".join(_wrapped(item, width) for item in items if item)


def _wrapped(item: str, width: int) -> str:
    indent = "  " if "- " in item[:2] else ""
    return "\n".join(wrap(plain_text(item), width, subsequent_indent=indent))


def plain_text(markdown: str, bold: str = "") -> str:
    """Return a line of Markdown as it prints; `bold` follows what is bold."""
    pieces = _CODE.split(_LINK.sub(r"\1", markdown))
    return "".join(x if i % 2 else _plain(x, bold) for i, x in enumerate(pieces)).strip()


def _plain(text: str, bold: str) -> str:
    whole = _BOLD.sub(lambda match: match[1] + bold, text)
    return unescape(_ESCAPED.sub(r"\1", whole))


def table_cells(line: str) -> list[str]:
    """Return the cells of a line of a pipe table, as Markdown."""
    inner = line.strip().removeprefix("|").removesuffix("|")
    return [cell.strip() for cell in _split(inner)]


def _split(line: str) -> Iterator[str]:
    """Parts between the bars that are neither escaped nor in code."""
    start = 0
    while True:
        match = _CELL.match(line, start)
        assert match is not None  # the pattern matches nothing as well
        yield match[0]
        if match.end() >= len(line):
            return
        start = match.end() + 1


def _table(lines: Sequence[str], width: int) -> str:
    head, sides, *rows = map(table_cells, lines)
    cells = [[plain_text(cell, BEST) for cell in row] for row in rows]
    right = [side.endswith(":") for side in sides]
    columns = [_marked(column) for column in zip(*cells, strict=True)]
    drawn = list(zip(*columns, strict=True))
    table = table_lines([plain_text(cell) for cell in head], drawn, right, width)
    has_best = any(map(_is_best, chain.from_iterable(cells)))
    return f"{table}\n{BEST} best of those that compete" if has_best else table


def _marked(column: Sequence[str]) -> list[str]:
    """Cells of a column with a blank where others have the mark, so that digits are aligned."""
    has_best = any(map(_is_best, column))
    return [_with_blank(text) if has_best else text for text in column]


def _is_best(cell: str) -> bool:
    return cell.partition(" ")[0].endswith(BEST)


def _with_blank(text: str) -> str:
    first, gap, rest = text.partition(" ")
    return text if first.endswith(BEST) else f"{first} {gap}{rest}"
