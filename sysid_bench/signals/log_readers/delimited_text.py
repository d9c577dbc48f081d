"""Delimited text: CSV and its variants, with or without a header."""

import csv
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, count, islice
from pathlib import Path
from typing import ClassVar, Final, TextIO

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, column_names
from sysid_bench.signals.read_progress import report
from sysid_bench.types import Array

_LARGEST: Final = 2**31
"""Bytes of a file, which is read in parts; its numbers take LARGEST_LOG at most."""

_LONGEST_LINE: Final = 2**20
_PART: Final = 20_000
"""Lines that are parsed at once."""

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
        check_file(path, _LARGEST)
        # Loggers write units and degree signs in any encoding; only the numbers matter.
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            header, first, lines = _split_header(_numbered_lines(path, file))
            if not first:
                raise UsageError(f"{path} holds no line of numbers.")
            delimiter = _delimiter(first[0][1])
            table = _Numbers(path, delimiter, len(_cells(first[0][1].strip(), delimiter)))
            for rows, is_last in _parts(chain(first, lines)):
                table.add(rows, is_last)
                report(path, os.lseek(file.fileno(), 0, os.SEEK_CUR), path.stat().st_size)
        words = _cells(header, _delimiter(header) or delimiter)
        # A title or a list of settings above the numbers has another number of words.
        names = column_names(path, words) if len(words) == table.width else {}
        return LogTable(path, table.values, names, table.truncated)


def _numbered_lines(path: Path, file: TextIO) -> Iterator[_Line]:
    """Yield the lines that are not blank; raises UsageError for one without end."""
    for number in count(1):
        line = file.readline(_LONGEST_LINE)
        if not line:
            return
        if len(line) == _LONGEST_LINE:
            raise UsageError(f"{path}, line {number} is longer than any line of a log.")
        if line.strip():
            yield number, line


def _split_header(lines: Iterator[_Line]) -> tuple[str, list[_Line], Iterator[_Line]]:
    """Return the line before the numbers, "" without one, the first line of numbers, [] without
    one, and the lines after it without comments."""
    header = ""
    for number, line in lines:
        mark = _comment_mark(line)
        if not mark and _holds_number(line):
            rest = (row for row in lines if not row[1].lstrip().startswith(_COMMENTS))
            return header, [(number, line)], rest
        header = line.strip().removeprefix(mark).strip()
    return header, [], lines


def _parts(lines: Iterable[_Line]) -> Iterator[tuple[list[_Line], bool]]:
    """Yield lines in parts, and whether a part is the last one."""
    rest = iter(lines)
    part = list(islice(rest, _PART))
    while part:
        following = list(islice(rest, _PART))
        yield part, not following
        part = following


class _Numbers:
    """Numbers (N, c) of a file, parsed part by part."""

    def __init__(self, path: Path, delimiter: str | None, width: int) -> None:
        self.width = width
        self.truncated = 0
        self._path, self._delimiter = path, delimiter
        self._stored: Array = np.empty((0, width))
        self._count = 0

    @property
    def values(self) -> Array:
        """The numbers of all parts so far."""
        return self._stored[: self._count]

    def add(self, rows: list[_Line], is_last: bool) -> None:
        """Parse a part; raises UsageError naming line and column, or for too many numbers."""
        part = self._parsed(rows, is_last)
        end = self._count + len(part)
        if end * self.width * 8 > LARGEST_LOG:
            raise UsageError(f"{self._path} holds more than {LARGEST_LOG} bytes of numbers.")
        if end > len(self._stored):
            # What is not yet written takes no memory; the old numbers are moved, not copied.
            self._stored.resize((max(end, 2 * len(self._stored)), self.width), refcheck=False)
        self._stored[self._count : end] = part
        self._count = end

    def _parsed(self, rows: list[_Line], is_last: bool) -> Array:
        try:
            values = np.loadtxt([line for _, line in rows], delimiter=self._delimiter, ndmin=2)
        except ValueError:
            # NumPy's C parser is ten times as quick, but refuses empty cells and names no column.
            return self._parsed_by_line(rows, is_last)
        return values if values.shape[1] == self.width else self._parsed_by_line(rows, is_last)

    def _parsed_by_line(self, rows: list[_Line], is_last: bool) -> Array:
        values: list[list[float]] = []
        for number, line in rows:
            cells = _cells(line.strip("\r\n"), self._delimiter)
            error = _line_error(self._path, number, cells, self.width)
            if error is None:
                values.append([float(cell or "nan") for cell in cells])
            elif is_last and number == rows[-1][0]:  # the logger was stopped while it wrote
                self.truncated = 1
            else:
                raise error
        return np.array(values).reshape(-1, self.width)


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
