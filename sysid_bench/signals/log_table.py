"""The numbers of a recorded file: CSV and its kin, npz, parquet, mat; columns by name or place."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.types import Array

DELIMITERS: Final = (",", ";", "\t")
COMMENTS: Final = ("#", "%", "//")
FORMATS: Final = (".csv", ".txt", ".dat", ".tsv", ".npz", ".npy", ".parquet", ".mat")


@dataclass(frozen=True, eq=False)
class LogTable:
    """Columns (N, c) of a file, the names that stand for one or more of them, and in how many of
    its last lines writing had broken off."""

    path: Path
    values: Array
    names: Mapping[str, tuple[int, ...]]
    truncated: int = 0

    def columns(self, chosen: Sequence[int | str]) -> Array:
        """(N, k) of columns by place from 1 or by name; UsageError names what there is."""
        places: list[int] = []
        for column in chosen:
            places += self._places(column)
        return self.values[:, places]

    def _places(self, column: int | str) -> tuple[int, ...]:
        if isinstance(column, str):
            key = column.strip()
            if key not in self.names:
                advice = "" if self.names else "Give columns by their place, from 1."
                raise UsageError(f"{self.path}: {unknown_name('column', key, self.names, advice)}")
            return self.names[key]
        if not 1 <= column <= self.values.shape[1]:
            raise UsageError(
                f"{self.path} has {self.values.shape[1]} columns, counted from 1; there is no "
                f"column {column}."
            )
        return (column - 1,)


@lru_cache(maxsize=4)
def _read_at(path: Path, stamp: tuple[int, int]) -> LogTable:
    del stamp  # part of the key: a file written again is read again
    match path.suffix.lower():
        case ".npz" | ".npy":
            return _read_numpy(path)
        case ".mat":
            return _read_matlab(path)
        case ".parquet":
            return _read_parquet(path)
        case ".csv" | ".txt" | ".dat" | ".tsv":
            return _read_text(path)
    raise UsageError(
        f"{path}: files that end in {path.suffix!r} cannot be read; there are {', '.join(FORMATS)}."
    )


def read_table(path: Path) -> LogTable:
    """The file as a table; UsageError naming file, line and column where it cannot be read."""
    try:
        stat = path.stat()
    except OSError as error:
        raise UsageError(f"There is no recorded file {str(path)!r} ({error.strerror}).") from error
    if not path.is_file():
        raise UsageError(f"{str(path)!r} is no file; name the recorded file itself.")
    try:
        return _read_at(path, (stat.st_mtime_ns, stat.st_size))
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def normalised_name(table: LogTable, per_row: int) -> LogTable:
    """A file with one number a line, `per_row` consecutive numbers a sample; what is left over at
    its end was broken off."""
    flat = table.values.ravel() if table.values.shape[1] == 1 else None
    if flat is None:
        raise UsageError(
            f"{table.path} has {table.values.shape[1]} columns; per_row is for files with one "
            "number a line."
        )
    whole = len(flat) // per_row
    left = len(flat) - whole * per_row
    values = flat[: whole * per_row].reshape(whole, per_row)
    return LogTable(table.path, values, {}, table.truncated + (1 if left else 0))


def _read_text(path: Path) -> LogTable:
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    numbered = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    header, rows = _without_header(numbered)
    if not rows:
        raise UsageError(f"{path} holds no line of numbers.")
    delimiter = _delimiter(rows[0][1])
    values, truncated = _numbers(path, rows, delimiter)
    names: dict[str, tuple[int, ...]] = {}
    if header is not None:
        words = _cells(header, _delimiter(header) or delimiter)
        if len(words) == values.shape[1]:
            names = _by_name(path, words)
    return LogTable(path, values, names, truncated)


def _without_header(lines: list[tuple[int, str]]) -> tuple[str | None, list[tuple[int, str]]]:
    """The line before the numbers (a comment, too) and the numbers without comments."""
    header: str | None = None
    for place, (_, line) in enumerate(lines):
        bare = line.strip()
        mark = next((mark for mark in COMMENTS if bare.startswith(mark)), None)
        if mark is None and any(_is_number(cell) for cell in _cells(bare, _delimiter(bare))):
            kept = [item for item in lines[place:] if not item[1].lstrip().startswith(COMMENTS)]
            return header, kept
        header = bare.removeprefix(mark or "").strip()
    return header, []


def _delimiter(line: str) -> str | None:
    """The first usual delimiter that a line holds; None: blanks."""
    return next((mark for mark in DELIMITERS if mark in line), None)


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


def _by_name(path: Path, words: Sequence[str]) -> dict[str, tuple[int, ...]]:
    names: dict[str, tuple[int, ...]] = {}
    for place, word in enumerate(words):
        if word and word in names:
            raise UsageError(
                f"{path}: columns {names[word][0] + 1} and {place + 1} are both called {word!r}; "
                "rename one."
            )
        if word:
            names[word] = (place,)
    return names


def _numbers(path: Path, rows: list[tuple[int, str]], delimiter: str | None) -> tuple[Array, int]:
    """(N, c), and whether the last line was broken off."""
    try:
        return np.loadtxt([line for _, line in rows], delimiter=delimiter, ndmin=2), 0
    except ValueError:
        return _slowly(path, rows, delimiter)


def _slowly(path: Path, rows: list[tuple[int, str]], delimiter: str | None) -> tuple[Array, int]:
    """Line by line: empty cells are not numbers but no mistake; a broken last line is left out."""
    width = len(_cells(rows[0][1], delimiter))
    values: list[list[float]] = []
    for place, (number, line) in enumerate(rows):
        cells = _cells(line, delimiter)
        bad = next((c for c, cell in enumerate(cells) if cell and not _is_number(cell)), None)
        if bad is None and len(cells) == width:
            values.append([float(cell) if cell else np.nan for cell in cells])
        elif place == len(rows) - 1:
            return np.array(values).reshape(-1, width), 1
        elif bad is not None:
            raise UsageError(
                f"{path}, line {number}, column {bad + 1}: {cells[bad]!r} is no number; mend the "
                "line, or start after it (rows = [first, last] counts lines of numbers)."
            )
        else:
            raise UsageError(
                f"{path}, line {number} has {len(cells)} columns; the first line of numbers has "
                f"{width}."
            )
    return np.array(values), 0


def _read_numpy(path: Path) -> LogTable:
    try:
        with path.open("rb") as file:
            found = np.load(file, allow_pickle=False)
            arrays = dict(found) if hasattr(found, "files") else {"": found}
    except (ValueError, EOFError, BadZipFile) as error:
        raise UsageError(f"{path} is no array file that can be read safely: {error}.") from error
    return _from_arrays(path, arrays)


def _read_matlab(path: Path) -> LogTable:
    from scipy.io import loadmat

    try:
        found = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError as error:
        raise UsageError(
            f"{path} is a MATLAB 7.3 file; save it with -v7 (save('log.mat', '-v7'))."
        ) from error
    except Exception as error:  # scipy raises what its parser trips over
        raise UsageError(f"{path} is no MATLAB file that can be read: {error}.") from error
    arrays: dict[str, Any] = {}
    for name, value in found.items():
        if not name.startswith("__"):
            _collect(arrays, name, value)
    return _from_arrays(path, arrays)


def _collect(arrays: dict[str, Any], name: str, value: Any) -> None:
    """Numeric arrays of a MATLAB variable, those inside of structs as "struct.field"."""
    fields = getattr(value, "_fieldnames", None)
    if fields is not None:
        for field in fields:
            _collect(arrays, f"{name}.{field}", getattr(value, field))
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        arrays[name] = value


def _from_arrays(path: Path, arrays: Mapping[str, Any]) -> LogTable:
    """Arrays of one length N side by side: (N,) is a column, (N, k) or (k, N) are k of them."""
    sized = {
        name: np.asarray(value, dtype=float)
        for name, value in arrays.items()
        if np.ndim(value) in (1, 2) and np.asarray(value).dtype.kind in "fiub"
    }
    if not sized:
        raise UsageError(f"{path} holds no array of numbers.")
    N = max(max(value.shape) for value in sized.values())
    parts, names, place = [], {}, 0
    for name, value in sized.items():
        if N not in value.shape:
            continue
        columns = value[:, None] if value.ndim == 1 else value if len(value) == N else value.T
        parts.append(columns)
        if name:
            names[name] = tuple(range(place, place + columns.shape[1]))
            if columns.shape[1] > 1:
                names |= {f"{name}:{c + 1}": (place + c,) for c in range(columns.shape[1])}
        place += columns.shape[1]
    return LogTable(path, np.concatenate(parts, axis=1), names)


def _read_parquet(path: Path) -> LogTable:
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(path)
    except (pyarrow.ArrowException, ValueError) as error:
        raise UsageError(f"{path} is no parquet file that can be read: {error}.") from error
    parts, words = [], []
    for name in table.column_names:
        kind = table.schema.field(name).type
        if pyarrow.types.is_timestamp(kind):
            column = table.column(name).cast(pyarrow.timestamp("ns")).cast(pyarrow.int64())
            parts.append(column.to_numpy().astype(float) * 1e-9)
        elif pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind):
            parts.append(np.asarray(table.column(name).to_numpy(), dtype=float))
        else:
            continue
        words.append(name.strip())
    if not parts or len(parts[0]) == 0:
        raise UsageError(f"{path} holds no column of numbers.")
    return LogTable(path, np.stack(parts, axis=1), _by_name(path, words))
