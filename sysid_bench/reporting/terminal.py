"""Markdown of tables and of the reference as text for a terminal, within its width."""

import re
from collections.abc import Iterable, Iterator, Sequence
from html import unescape
from itertools import chain, groupby, zip_longest
from textwrap import wrap
from typing import Any, Final

GAP: Final = "  "
_NARROWEST: Final = 8
"""Width (letters) below which no column of words is wrapped."""
_LONGEST_WORD: Final = 24
"""Letters of a word that a column is kept wide for; longer ones are broken."""

Lines = Sequence[Sequence[str]]


def table_lines(head: Sequence[str], rows: Lines, right: Sequence[bool], width: int) -> str:
    """Return a head, a rule and rows as lines of at most `width` letters.

    `right` marks columns of numbers, which are aligned right and never wrapped. Where the columns
    do not fit side by side, the table is drawn in parts, each with the columns before the first
    number.
    """
    table = [head, *rows]
    natural, least = _natural(table, right), []
    # Widths down to which the columns can be wrapped; the first one keeps its words whole.
    for i, size in enumerate(natural):
        longest = max(_longest_word(row[i]) for row in table)
        kept = longest if i == 0 else min(longest, _LONGEST_WORD)
        least.append(size if right[i] else min(size, max(kept, _NARROWEST)))
    # Columns before the first number name the row, and stand in each part; of the others as many
    # as fit beside them.
    keys = list(right).index(True) if True in right[1:] and not right[0] else 1
    first = list(range(min(keys, len(least))))
    parts: list[list[int]] = [[]]
    for i in range(len(first), len(least)):
        if parts[-1] and _total(least[j] for j in (*first, *parts[-1], i)) > width:
            parts.append([])
        parts[-1].append(i)
    return "\n\n".join(_draw(table, first + part, right, natural, least, width) for part in parts)


def _natural(table: Lines, right: Sequence[bool]) -> list[int]:
    """Widths of the columns without any wrap, but for the heads of numbers."""
    columns = list(zip(*table[1:], strict=True)) or [()] * len(right)
    longest = (max(map(len, column), default=0) for column in columns)
    heads = (
        _longest_word(text) if is_number else len(text)
        for text, is_number in zip(table[0], right, strict=True)
    )
    return [max(pair) for pair in zip(longest, heads, strict=True)]


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def _total(widths: Iterable[int]) -> int:
    """Letters of columns side by side."""
    found = list(widths)
    return sum(found) + len(GAP) * (len(found) - 1)


def _draw(
    table: Lines,
    part: Sequence[int],
    right: Sequence[bool],
    widths: Sequence[int],
    least: Sequence[int],
    width: int,
) -> str:
    def of_part(values: Sequence[Any]) -> list[Any]:
        return [values[i] for i in part]

    sizes, smallest, sides = map(of_part, (widths, least, right))
    # The widest column is made narrower first, as far as columns can be wrapped.
    while _total(sizes) > width:
        loose = [i for i, size in enumerate(sizes) if size > smallest[i]]
        if not loose:
            break
        sizes[max(loose, key=sizes.__getitem__)] -= 1
    head, *rows = map(of_part, table)
    lines = list(_line(head, sizes, sides, is_head=True))
    lines.append("─" * min(_total(sizes), width))
    for row in rows:
        lines += _line(row, sizes, sides)
    return "\n".join(lines)


def _line(
    row: Sequence[str], sizes: Sequence[int], right: Sequence[bool], is_head: bool = False
) -> Iterator[str]:
    """Lines of a row: its wrapped cells side by side; a head stands on the rule."""
    cells = [
        [text] if is_number and not is_head else wrap(text, max(size, 1)) or [""]
        for text, size, is_number in zip(row, sizes, right, strict=True)
    ]
    if is_head:
        height = max(map(len, cells))
        cells = [[""] * (height - len(cell)) + cell for cell in cells]
    for texts in zip_longest(*cells, fillvalue=""):
        sides = zip(texts, sizes, right, strict=True)
        padded = (text.rjust(n) if is_number else text.ljust(n) for text, n, is_number in sides)
        yield GAP.join(padded).rstrip()


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
        return "\n".join(f"    {line}" for line in lines if not line.startswith(_FENCE))
    if first.startswith("    "):
        return "\n".join(lines)
    if first.startswith("| ") and len(lines) > 1:
        return _table(lines, width)
    heading = _HEADING.fullmatch(first)
    if heading and len(lines) == 1:
        text, rule = plain_text(heading[2]), _RULES.get(len(heading[1]))
        return f"{text}\n{rule * len(text)}" if rule else text
    return _paragraph(lines, min(width, WIDEST))


def _paragraph(lines: Sequence[str], width: int) -> str:
    """Wrapped text; items of a list begin with a dash."""
    items = [""]
    for line in lines:
        if line.startswith("- "):
            items.append(line)
        else:
            items[-1] += f" {line.strip()}"
    texts = []
    for item in filter(None, items):
        indent = "  " if "- " in item[:2] else ""
        texts.append("\n".join(wrap(plain_text(item), width, subsequent_indent=indent)))
    return "\n".join(texts)


def plain_text(markdown: str, bold: str = "") -> str:
    """Return a line of Markdown as it prints; `bold` follows what is bold."""
    pieces = _CODE.split(_LINK.sub(r"\1", markdown))
    for i in range(0, len(pieces), 2):  # the others are code, which prints as it is
        marked = _BOLD.sub(lambda match: match[1] + bold, pieces[i])
        pieces[i] = unescape(_ESCAPED.sub(r"\1", marked))
    return "".join(pieces).strip()


def table_cells(line: str) -> list[str]:
    """Return the cells of a line of a pipe table, as Markdown."""
    inner = line.strip().removeprefix("|").removesuffix("|")
    cells, start = [], 0
    # Bars that are escaped or in code part no cells.
    while start <= len(inner):
        match = _CELL.match(inner, start)
        assert match is not None  # the pattern matches nothing as well
        cells.append(match[0].strip())
        start = match.end() + 1
    return cells


def _table(lines: Sequence[str], width: int) -> str:
    head, sides, *rows = map(table_cells, lines)
    cells = [[plain_text(cell, BEST) for cell in row] for row in rows]
    right = [side.endswith(":") for side in sides]
    columns = [_aligned_marks(column) for column in zip(*cells, strict=True)]
    drawn = list(zip(*columns, strict=True))
    table = table_lines([plain_text(cell) for cell in head], drawn, right, width)
    has_best = any(map(_is_best, chain.from_iterable(cells)))
    return f"{table}\n{BEST} best of those that compete" if has_best else table


def _aligned_marks(column: Sequence[str]) -> list[str]:
    """Cells of a column with a blank where others have the mark, so that digits are aligned."""
    if not any(map(_is_best, column)):
        return list(column)
    parts = [(text, *text.partition(" ")) for text in column]
    return [text if _is_best(text) else f"{first} {gap}{rest}" for text, first, gap, rest in parts]


def _is_best(cell: str) -> bool:
    return cell.partition(" ")[0].endswith(BEST)
