"""Texts in columns for a terminal: aligned, within its width, long texts wrapped."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
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
    widths, least = _natural(table, right), _least(table, right)
    parts = _parts(least, _keys(right), width)
    return "\n\n".join(_draw(table, part, right, widths, least, width) for part in parts)


def _natural(table: Lines, right: Sequence[bool]) -> list[int]:
    """Widths of the columns without any wrap, but for the heads of numbers."""
    columns = list(zip(*table[1:], strict=True)) or [()] * len(right)
    longest = (max(map(len, column), default=0) for column in columns)
    heads = (
        _longest_word(text) if is_number else len(text)
        for text, is_number in zip(table[0], right, strict=True)
    )
    return [max(pair) for pair in zip(longest, heads, strict=True)]


def _least(table: Lines, right: Sequence[bool]) -> list[int]:
    """Widths down to which the columns can be wrapped; the first one keeps its words whole."""
    least = []
    for i, natural in enumerate(_natural(table, right)):
        longest = max(_longest_word(row[i]) for row in table)
        kept = longest if i == 0 else min(longest, _LONGEST_WORD)
        least.append(natural if right[i] else min(natural, max(kept, _NARROWEST)))
    return least


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def _keys(right: Sequence[bool]) -> int:
    """Number of columns before the first number; one where there is none."""
    return list(right).index(True) if True in right[1:] and not right[0] else 1


def _parts(least: Sequence[int], keys: int, width: int) -> list[list[int]]:
    """Columns of each part, as many as fit beside the first `keys`."""
    first = list(range(min(keys, len(least))))
    parts: list[list[int]] = [[]]
    for i in range(len(first), len(least)):
        if parts[-1] and _total(least[j] for j in (*first, *parts[-1], i)) > width:
            parts.append([])
        parts[-1].append(i)
    return [first + part for part in parts]


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

    sizes = _shrunk(of_part(widths), of_part(least), width)
    sides = of_part(right)
    head, *rows = map(of_part, table)
    lines = list(_line(head, sizes, sides, is_head=True))
    lines.append("─" * min(_total(sizes), width))
    for row in rows:
        lines += _line(row, sizes, sides)
    return "\n".join(lines)


def _shrunk(widths: list[int], least: Sequence[int], width: int) -> list[int]:
    """Widths within a width as far as columns can be wrapped, the widest made narrower first."""
    while _total(widths) > width:
        loose = [i for i, pair in enumerate(zip(widths, least, strict=True)) if pair[0] > pair[1]]
        if not loose:
            return widths
        widths[max(loose, key=widths.__getitem__)] -= 1
    return widths


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
        yield GAP.join(map(_padded, texts, sizes, right)).rstrip()


def _padded(text: str, size: int, is_number: bool) -> str:
    return text.rjust(size) if is_number else text.ljust(size)
