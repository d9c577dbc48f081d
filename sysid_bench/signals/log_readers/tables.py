"""Files of columns by name: delimited text, parquet, and the parquet files of LeRobot."""

import csv
import os
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count, islice
from pathlib import Path
from typing import Any, ClassVar, Final, TextIO

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file, parse_json, read_text
from sysid_bench.signals.log_library import library_errors, log_library, report
from sysid_bench.signals.log_table import (
    LARGEST_LOG,
    LogTable,
    array_names,
    check_size,
    column_names,
    columns_with_names,
)
from sysid_bench.types import Array

_LARGEST: Final = 2**31
"""Bytes of a text, which is read in parts; its numbers take LARGEST_LOG at most."""

_LONGEST_LINE: Final = 2**20
_PART: Final = 20_000
"""Lines that are parsed at once."""

_DELIMITERS: Final = (",", ";", "\t")
_COMMENTS: Final = ("#", "%", "//")

_BATCH: Final = 65_536
"""Rows of parquet that are unpacked at once."""

_EPISODE: Final = "episode_index"
_DOUBT: Final = (
    "LeRobot states no units: positions may be in rad, in degrees, or in percent of a calibrated "
    "range. Write unit = 'rad' or unit = 'deg'; percent needs gain = [...] in rad for each"
)

_LIST: Final = re.compile(r'((?:^|[,;\t])\s*)"?(\[[^\[\]"]*\])"?')
"""List of numbers that is a whole cell, after what stands before it."""

_DECIMAL_COMMAS: Final = re.compile(r"(?=.*\d,\d)[-+\d,eE \"]*([;\t][-+\d,eE \"]*)+")
"""Line of numbers with decimal commas between semicolons or tabs: 0,25;-1,5."""

_LOOKED_AT: Final = 1000
"""Lines in which decimal commas are looked for."""

_COMPARED: Final = 10
"""Last lines whose decimals are compared."""

_Line = tuple[int, str]
"""Number of a line, from 1, and its text."""


@dataclass(frozen=True)
class DelimitedText:
    """Lines of numbers separated by comma, semicolon, tab or blanks. The last line before the
    numbers, a comment too, names the columns where it has as many words. A list of numbers in a
    cell, [0.1, 0.2], is an array; columns of words are NaN."""

    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".txt", ".dat", ".tsv")

    def read(self, path: Path) -> LogTable:
        """Return the numbers; empty cells are NaN, an incomplete last line is dropped and counted.

        Raises UsageError naming line and column.
        """
        check_file(path, _LARGEST)
        # Loggers write units and degree signs in any encoding; only the numbers matter.
        with path.open("rb") as start_of_file:
            is_wide = start_of_file.read(2) in (BOM_UTF16_LE, BOM_UTF16_BE)
        with path.open(encoding="utf-16" if is_wide else "utf-8-sig", errors="replace") as file:
            lines = _numbered_lines(path, file)
            header, first = _header(path, lines)
            # A start at rest, "283;0;0", has no comma yet.
            ahead = list(islice(lines, _LOOKED_AT))
            lines = chain(ahead, lines)
            if any(_DECIMAL_COMMAS.fullmatch(line.strip()) for _, line in (first, *ahead)):
                first = first[0], first[1].replace(",", ".")
                lines = ((number, line.replace(",", ".")) for number, line in lines)
            delimiter = _delimiter(first[1])
            numbers = (row for row in lines if not row[1].lstrip().startswith(_COMMENTS))
            start = [first, *islice(numbers, 1)]
            rows: Iterator[_Line] = chain(start, numbers)
            plain = not any(map(_is_text, _cells(first[1], delimiter)))
            widths = [1] * len(_cells(first[1], delimiter))
            if not plain:
                widths, texts = _array_columns(start, delimiter)
                rows = ((n, _flat(line, delimiter, texts)) for n, line in rows)
            table = _Numbers(path, delimiter if plain else ",", sum(widths))
            part = list(islice(rows, _PART))
            while part:
                following = list(islice(rows, _PART))
                table.add(part, is_last=not following)
                report(path, os.lseek(file.fileno(), 0, os.SEEK_CUR), path.stat().st_size)
                part = following
        words = _cells(header, _delimiter(header) or delimiter)
        # A title or a list of settings above the numbers has another number of words.
        names = column_names(path, words) if len(words) == len(widths) else {}
        if not plain:
            ends = np.cumsum([0, *widths])
            at = {name: range(ends[i], ends[i + 1]) for name, (i,) in names.items()}
            names = {k: v for name, part in at.items() for k, v in array_names(name, part).items()}
        return LogTable(path, table.values[: table.count], names, table.truncated)


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


def _header(path: Path, lines: Iterator[_Line]) -> tuple[str, _Line]:
    """Return the line before the numbers, "" without one, and the first line of numbers."""
    header = ""
    for number, line in lines:
        bare = line.strip()
        mark = next((mark for mark in _COMMENTS if bare.startswith(mark)), "")
        cells = _cells(bare, _delimiter(bare))
        if not mark and (any(map(_is_number, cells)) or any(_items(cell) for cell in cells)):
            return header, (number, line)
        header = bare.removeprefix(mark).strip()
    raise UsageError(f"{path} holds no line of numbers.")


class _Numbers:
    """Numbers (N, c) of a file, parsed part by part: the first `count` rows of `values`."""

    def __init__(self, path: Path, delimiter: str | None, width: int) -> None:
        self.width, self.truncated, self.count = width, 0, 0
        self.values: Array = np.empty((0, width))
        self._path, self._delimiter = path, delimiter

    def add(self, rows: list[_Line], is_last: bool) -> None:
        """Parse a part; raises UsageError naming line and column, or for too many numbers."""
        if is_last and _is_cut(rows, self._delimiter):
            rows, self.truncated = rows[:-1], 1
        try:
            part = np.loadtxt([line for _, line in rows], delimiter=self._delimiter, ndmin=2)
        except ValueError:
            part = np.empty((0, 0))
        if part.shape[1] != self.width:
            # NumPy's C parser is ten times as quick, but refuses empty cells and names no column.
            part = self._parsed_by_line(rows, is_last)
        end = self.count + len(part)
        if end * self.width * 8 > LARGEST_LOG:
            raise UsageError(f"{self._path} holds more than {LARGEST_LOG} bytes of numbers.")
        if end > len(self.values):
            # What is not yet written takes no memory; the old numbers are moved, not copied.
            self.values.resize((max(end, 2 * len(self.values)), self.width), refcheck=False)
        self.values[self.count : end] = part
        self.count = end

    def _parsed_by_line(self, rows: list[_Line], is_last: bool) -> Array:
        values: list[list[float]] = []
        for number, line in rows:
            cells = _cells(line, self._delimiter)
            wrong = [c for c, cell in enumerate(cells) if cell and not _is_number(cell)]
            if not wrong and len(cells) == self.width:
                values.append([float(cell or "nan") for cell in cells])
            elif is_last and number == rows[-1][0]:  # the logger was stopped while it wrote
                self.truncated = 1
            elif wrong:
                raise UsageError(
                    f"{self._path}, line {number}, column {wrong[0] + 1}: {cells[wrong[0]]!r} is "
                    "not a number; fix the line, or start after it (rows = [first, last] counts "
                    "lines of numbers)."
                )
            else:
                raise UsageError(
                    f"{self._path}, line {number} has {len(cells)} columns; the first line of "
                    f"numbers has {self.width}."
                )
        return np.array(values).reshape(-1, self.width)


def _is_cut(rows: Sequence[_Line], delimiter: str | None) -> bool:
    """Test whether the file ends inside of its last number: without an end of the line, and with
    fewer decimals than all the others of that column, which have the same number."""
    if rows[-1][1].endswith(("\n", "\r")) or len(rows) < _COMPARED:
        return False
    cells = [_cells(line, delimiter)[-1] for _, line in rows[-_COMPARED:]]
    *before, last = (len(cell.partition(".")[2]) for cell in cells)
    return len(set(before)) == 1 and last < before[0]


def _delimiter(line: str) -> str | None:
    """Return the first usual delimiter in a line, None for blanks."""
    line = _LIST.sub(r"\1", line)
    return next((mark for mark in _DELIMITERS if mark in line), None)


def _cells(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    # A list has the delimiter inside it, in quotes or not.
    line = _LIST.sub(r'\1"\2"', line.strip("\r\n"))
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]


def _items(cell: str) -> list[str]:
    """Return the numbers of a list in a cell, [] where it is none."""
    if not (cell.startswith("[") and cell.endswith("]")):
        return []
    return re.split(r"[\s,;]+", cell[1:-1].strip())


def _is_text(cell: str) -> bool:
    return bool(cell) and not _is_number(cell)


def _array_columns(
    start: Sequence[_Line], delimiter: str | None
) -> tuple[list[int], frozenset[int]]:
    """Return the width of each column by the first lines, and the columns of words."""
    rows = [_cells(line, delimiter) for _, line in start]
    texts = [{c for c, x in enumerate(row) if _is_text(x) and not _items(x)} for row in rows]
    return [max(len(_items(x)), 1) for x in rows[0]], frozenset(set.intersection(*texts))


def _flat(line: str, delimiter: str | None, texts: frozenset[int]) -> str:
    """Return a line with the numbers of its lists side by side, and nan for words."""
    cells = enumerate(_cells(line, delimiter))
    end = "\n" * line.endswith("\n")
    return ",".join("nan" if c in texts else ",".join(_items(x) or [x]) for c, x in cells) + end


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class Parquet:
    """Columns of numbers, of lists of numbers of one length, and of time stamps (s); the others in
    the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".parquet",)

    def read(self, path: Path) -> LogTable:
        """Return the columns by name; raises UsageError where none holds numbers, or for a damaged
        file."""
        arrays = _read_parquet(path)
        values, names = columns_with_names(path, {name: (x, ()) for name, x in arrays.items()})
        return LogTable(path, values, names)


def _read_parquet(path: Path, columns: Sequence[str] | None = None) -> dict[str, Array]:
    """Return the numeric columns (N, k) of a parquet file, or some of them, by name, as parts of
    one array.

    Raises UsageError for a damaged file or one without numbers, OSError for one that is not a file
    or too large.
    """
    parquet = log_library("pyarrow.parquet", path)

    check_file(path, LARGEST_LOG)
    found: dict[str, Array] = {}
    done = 0
    with library_errors(path, "a parquet file that can be read"):
        file = parquet.ParquetFile(path)
        groups = [file.metadata.row_group(k) for k in range(file.num_row_groups)]
        N, unpacked = file.metadata.num_rows, sum(group.total_byte_size for group in groups)
        # Repeated values take next to no place in the file.
        check_size(path, max(8 * N * file.metadata.num_columns, unpacked))
        for group in range(file.num_row_groups):
            for batch in file.iter_batches(_BATCH, [group], columns, use_threads=False):
                arrays = _batch_columns(path, batch)
                if not done:
                    widths = [x.shape[1] for x in arrays.values()]
                    parts = np.split(np.empty((N, sum(widths))), np.cumsum(widths)[:-1], axis=1)
                    found = dict(zip(arrays, parts, strict=True))
                # A column that is not numeric in one batch is left out.
                found = {k: x for k, x in found.items() if k in arrays and _is_like(x, arrays[k])}
                for name, x in found.items():
                    x[done : done + len(batch)] = arrays[name]
                done += len(batch)
                report(path, done, N)
            # What Arrow has unpacked of a group of rows is given back.
            log_library("pyarrow", path).default_memory_pool().release_unused()
    if not found or done != N:
        raise UsageError(f"{path} holds no column of numbers.")
    return found


def _is_like(whole: Array, part: Array) -> bool:
    return bool(part.shape[1] == whole.shape[1])


def _batch_columns(path: Path, batch: Any) -> dict[str, Array]:
    """Return the columns of a batch as floats (N, k): numbers, lists of numbers of one length, and
    time stamps in s; raises UsageError for a name that two have."""
    from pyarrow import int64, timestamp, types

    found: dict[str, Array] = {}
    for written, column in zip(batch.schema.names, batch.columns, strict=True):
        name, kind, k, scale = written.strip(), column.type, 1, 1.0
        if types.is_list(kind) or types.is_fixed_size_list(kind):
            lengths = {len(value) for value in column} if not column.null_count else set()
            column, kind = column.flatten(), kind.value_type
            k = lengths.pop() if len(lengths) == 1 else 0
        elif types.is_timestamp(kind):
            # Through whole nanoseconds, since a file may hold ms, us or ns.
            column, kind, scale = column.cast(timestamp("ns")).cast(int64()), int64(), 1e-9
        if k == 0 or not (types.is_floating(kind) or types.is_integer(kind)):
            continue
        if name in found:
            raise UsageError(f"{path}: two columns are named {name!r}; rename one.")
        floats = np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)
        found[name] = (floats if scale == 1.0 else floats * scale).reshape(-1, k)
    return found


@dataclass(frozen=True)
class Lerobot:
    """One episode of a LeRobot data set, version 2 or 3: the folder with meta/info.json and parquet
    files. Features are arrays, their columns named as in meta/info.json
    ("observation.state.elbow"), at the rate stated there."""

    episode: int | None = None
    suffixes: ClassVar[tuple[str, ...]] = ()
    folder_files: ClassVar[tuple[str, ...]] = ("meta/info.json", "data/**/*.parquet")

    def read(self, path: Path) -> LogTable:
        """Return the columns of an episode; raises UsageError where several exist and none is
        chosen, and for a damaged file."""
        file = path / "meta" / "info.json"
        try:
            info = parse_json(read_text(file))
        except ValueError as error:
            raise UsageError(f"{file} is not valid JSON: {error}.") from error
        if not isinstance(info, Mapping):
            raise UsageError(f"{file} is not the description of a LeRobot data set.")
        total, rate = info.get("total_episodes"), info.get("fps")
        episode = 0 if self.episode is None and total == 1 else self.episode
        if episode is None:
            raise UsageError(
                f"{path} holds {total} episodes; choose one with reader = {{ use = 'lerobot', "
                "episode = 0 }."
            )
        arrays = _episode_arrays(path, episode)
        named = {name: (x, _words(info, name, x.shape[1])) for name, x in arrays.items()}
        values, names = columns_with_names(path, named)
        known = float(rate) if isinstance(rate, (int, float)) and 0 < rate < 1e9 else None
        return LogTable(path, values, names, rate=known, unit_doubt=_DOUBT)


def _episode_arrays(path: Path, episode: int) -> dict[str, Array]:
    """Return the columns of one episode that all of its files have, one file after the other.

    Raises UsageError with the number of files looked through where it is in none of them.
    """
    files = sorted(path.glob("data/**/*.parquet"))
    own = [file for file in files if file.name == f"episode_{episode:06d}.parquet"]
    parts = []
    for file in own or files:
        # Its other columns are unpacked only where the file holds the episode.
        rows = _read_parquet(file, [_EPISODE])[_EPISODE][:, 0] == episode
        if rows.any():
            parts.append({name: x[rows] for name, x in _read_parquet(file).items()})
    if not parts:
        raise UsageError(f"{path}: no episode {episode} in its {len(files)} parquet files.")
    shared = set.intersection(*map(set, parts))
    return {
        name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name in shared
    }


def _words(info: Mapping[str, Any], feature: str, width: int) -> list[str]:
    """Return names of the columns of a feature, [] where the file has none for each of them."""
    written: Any = info
    for key in ("features", feature, "names"):
        written = written.get(key) if isinstance(written, Mapping) else None
    if isinstance(written, Mapping):  # such as {"motors": [...]}
        written = list(chain(*(value for value in written.values() if isinstance(value, list))))
    listed = written if isinstance(written, list) else []
    words = [word for word in listed if isinstance(word, str)]
    unique = len(set(words)) == len(words) == width > 1
    return [f"{feature}.{word}" for word in words] if unique else []
