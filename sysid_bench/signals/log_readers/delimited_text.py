"""Delimited text: CSV and its variants, with or without a header."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import read_data
from sysid_bench.signals.log_table import LogTable, column_names
from sysid_bench.types import Array

_LARGEST: Final = 2**28
"""Bytes; the lines of a text take several times as much memory."""

_DELIMITERS: Final = (",", ";", "\t")
_COMMENTS: Final = ("#", "%", "//")

_Line = tuple[int, str]
"""Number of a line, from 1, and its text."""


@dataclass(frozen=True)
class DelimitedText:
    """Lines of numbers separated by comma, semicolon, tab or blanks. The last line before the
    numbers, a comment too, names the columns where it has as many words."""

    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".txt", ".dat", ".tsv")

    def read(self, path: Path) -> LogTable:
        """Return the numbers; empty cells are NaN, an incomplete last line is dropped and counted.

        Raises UsageError naming line and column.
        """
        # Loggers write units and degree signs in any encoding; only the numbers matter.
        text = read_data(path, _LARGEST).decode("utf-8-sig", errors="replace")
        numbered = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
        header, rows = _split_header(numbered)
        if not rows:
            raise UsageError(f"{path} holds no line of numbers.")
        delimiter = _delimiter(rows[0][1])
        values, truncated = _numbers(path, rows, delimiter)
        words = _cells(header, _delimiter(header) or delimiter)
        # A title or a list of settings above the numbers has another number of words.
        names = column_names(path, words) if len(words) == values.shape[1] else {}
        return LogTable(path, values, names, truncated)


def _split_header(lines: list[_Line]) -> tuple[str, list[_Line]]:
    """Return the line before the numbers, "" without one, and the lines of numbers without
    comments."""
    header = ""
    for index, (_, line) in enumerate(lines):
        mark = _comment_mark(line)
        if not mark and _holds_number(line):
            rows = [row for row in lines[index:] if not row[1].lstrip().startswith(_COMMENTS)]
            return header, rows
        header = line.strip().removeprefix(mark).strip()
    return header, []


def _comment_mark(line: str) -> str:
    """Return the mark that makes a line a comment, "" for another line."""
    return next((mark for mark in _COMMENTS if line.lstrip().startswith(mark)), "")


def _holds_number(line: str) -> bool:
    bare = line.strip()
    return any(map(_is_number, _cells(bare, _delimiter(bare))))


def _delimiter(line: str) -> str | None:
    """Return the first usual delimiter in a line, None for blanks."""
    return next((mark for mark in _DELIMITERS if mark in line), None)


def _cells(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(path: Path, rows: list[_Line], delimiter: str | None) -> tuple[Array, int]:
    """Return (N, c), and 1 where the last line was incomplete."""
    try:
        return np.loadtxt([line for _, line in rows], delimiter=delimiter, ndmin=2), 0
    except ValueError:
        # NumPy's C parser is ten times as quick, but refuses empty cells and names no column.
        return _numbers_by_line(path, rows, delimiter)


def _numbers_by_line(path: Path, rows: list[_Line], delimiter: str | None) -> tuple[Array, int]:
    width = len(_cells(rows[0][1], delimiter))
    values: list[list[float]] = []
    for number, line in rows:
        cells = _cells(line, delimiter)
        error = _line_error(path, number, cells, width)
        if error is None:
            values.append([float(cell or "nan") for cell in cells])
        elif number == rows[-1][0]:  # the logger was stopped while it wrote
            return np.array(values).reshape(-1, width), 1
        else:
            raise error
    return np.array(values), 0


def _line_error(path: Path, number: int, cells: list[str], width: int) -> UsageError | None:
    """Return what is wrong in a line, None for numbers and empty cells of the right count."""
    wrong = _wrong_cell(cells)
    if wrong is not None:
        return UsageError(
            f"{path}, line {number}, column {wrong + 1}: {cells[wrong]!r} is not a number; fix "
            "the line, or start after it (rows = [first, last] counts lines of numbers)."
        )
    if len(cells) != width:
        return UsageError(
            f"{path}, line {number} has {len(cells)} columns; the first line of numbers has "
            f"{width}."
        )
    return None


def _wrong_cell(cells: list[str]) -> int | None:
    """Return the index of the first cell that is neither a number nor empty."""
    return next((c for c, cell in enumerate(cells) if cell and not _is_number(cell)), None)
