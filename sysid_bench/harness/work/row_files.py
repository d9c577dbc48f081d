"""Row files: append-only JSON lines, one writer per file; of rows with one id the last holds.

A table of a row, a list of entries with the same keys, is written by column: {"columns": {key:
values}}. Readers return lists of entries; files with lists of entries are read, too. Each line ends
with the hash of its row: a row that was changed afterwards is not a row.
"""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import orjson

from sysid_bench.canonical_json import plain
from sysid_bench.errors import UsageError
from sysid_bench.types import Row
from sysid_bench.words import STATUSES

HASH: Final = "row_sha256"
"""The last field of a line."""

_BEGIN: Final = f', "{HASH}": "'.encode()
_SIZE: Final = len(_BEGIN) + 64 + len(b'"}')


def with_hash(line: bytes) -> bytes:
    """Return the line of a JSON object, which has fields, with its hash."""
    # Of the bytes as they stand before it: a reader needs no second serialization to check it.
    return line[:-1] + _BEGIN + hashlib.sha256(line).hexdigest().encode() + b'"}'


def without_hash(line: bytes) -> bytes:
    """Return the JSON object to which `with_hash` gave its hash; a line without one, or with that
    of other bytes, as it is."""
    text = line.rstrip()
    # Size and place of the hash are fixed, so that nothing is parsed.
    content = text[:-_SIZE] + b"}"
    return content if text == with_hash(content) else line


def hash_error(line: bytes, *, hashed: bool) -> str | None:
    """Return the id of a row that was changed after it was written, of a run with `hashed` rows
    also of one without a hash; None for any other line."""
    text = without_hash(line)
    try:
        row = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if text != line or not isinstance(row, dict) or not isinstance(row.get("id"), str):
        return None
    return row["id"] if hashed or HASH in row else None


ROWS_DIGEST: Final = "rows_sha256"
"""Key of env.json: the digest of all rows at the end of a run."""


def rows_digest(folder: Path) -> str:
    """Return the SHA-256 of the lines of all row files of a folder, file after file in the order in
    which they were made."""
    digest = hashlib.sha256()
    for path in row_files(folder):
        with path.open("rb") as file:
            while part := file.read(_BLOCK):
                digest.update(part)
    return digest.hexdigest()


TABLES: Final = ("joints", "parameters_table")
"""Fields of a row that are tables."""


def is_row(value: Any) -> bool:
    """Test for an object with an id, a known status, and tables by entry or by column."""
    if not isinstance(value, dict) or not isinstance(value.get("id"), str):
        return False
    return value.get("status") in STATUSES and all(_is_table(value.get(key)) for key in TABLES)


def _is_table(value: Any) -> bool:
    """Test for nothing, a list of objects, or {"columns": {key: values}} of one length."""
    if isinstance(value, dict):
        columns = value.get("columns")
        if len(value) != 1 or not isinstance(columns, dict) or not columns:
            return False
        sizes = [len(column) if isinstance(column, list) else -1 for column in columns.values()]
        return len(set(sizes)) == 1 and sizes[0] >= 0
    entries = [] if value is None else value
    return isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)


LARGEST_ROW: Final = 2**26
"""Most bytes of a row; a longer line is not read into memory."""

_BLOCK: Final = 2**20

SYNC_SECONDS = 1.0
"""Interval of fsync; once per row would cost four times as much as writing it."""


@dataclass(frozen=True)
class StoredRows:
    """The last row of every id. `torn` counts unfinished last lines of writers that were killed;
    `garbled` lists every other line that is not a row ("file:line")."""

    rows: dict[str, Row]
    torn: int
    garbled: tuple[str, ...]


class Line(NamedTuple):
    """One line of a row file; `end` is the offset behind it. An unfinished one is the last."""

    number: int
    text: bytes
    end: int
    unfinished: bool


class RowStart(NamedTuple):
    """Row file, offset and line of a row."""

    path: Path
    start: int
    line: int

    def read(self) -> Row:
        """Return the row."""
        return with_entries(_json(without_hash(next(lines(self.path, 0, self.start)).text)))


class RowWriter:
    """Appends rows to its own file; once `write` returns, the operating system holds the row."""

    def __init__(self, path: Path) -> None:
        # A file for each writer needs no lock, also on network folders, where SQLite's WAL is not
        # safe; 10,000 rows took 1.8 s as JSON lines, 4 s in SQLite and 59 s as a Parquet file each.
        self.path = path
        # Without a buffer of Python's: kill -9 of the writer loses no row that was announced.
        self._file = path.open("ab", buffering=0)
        self._synced = time.monotonic()

    def write(self, row: Row) -> None:
        """Append one line. Raises before writing: TypeError for values that are not JSON,
        UsageError for a row that no reader takes."""
        for name in TABLES:
            table = row.get(name)
            if isinstance(table, list) and all(isinstance(entry, dict) for entry in table):
                keys = set(map(tuple, table))
                # By column: 23 of the 28 kB of a row were a table with its keys in 81 lines.
                if len(keys) == 1 and keys != {()}:  # alike, in the same order, too
                    columns = {key: [entry[key] for entry in table] for key in table[0]}
                    row = {**row, name: {"columns": columns}}
        line = with_hash(_text(row)) + b"\n"
        if len(line) > LARGEST_ROW:
            raise UsageError(
                f"The row has {len(line) / 1e6:.0f} MB; {LARGEST_ROW / 1e6:.0f} MB are stored at "
                "most. Let the method return less in 'stats'."
            )
        start = self._file.tell()
        try:
            # A raw file may take less than all of it.
            while line:
                line = line[self._file.write(line) :]
        except OSError:  # all or nothing: a full disk may take a part of a line
            self._file.truncate(start)
            raise
        if time.monotonic() - self._synced > SYNC_SECONDS:
            self._sync()

    def close(self) -> None:
        """Force the rest to the disk; closing twice is allowed. What a full disk does not take has
        been reported by `write`."""
        with contextlib.suppress(OSError):
            if not self._file.closed:
                self._sync()
        self._file.close()

    def __enter__(self) -> "RowWriter":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced = time.monotonic()


# Only what `plain` takes, too.
_OPTION: Final = orjson.OPT_PASSTHROUGH_DATACLASS | orjson.OPT_PASSTHROUGH_DATETIME


def _text(row: Row | str) -> bytes:
    """Return the JSON text of a row or an id, NaN as null. Raises TypeError for other values."""
    # A line per cell, so that a kill costs one cell; of a row of 15 kB orjson makes the text in
    # 0.02 ms and the hash is 0.01 ms, where Python's json took 0.4 ms.
    try:
        return orjson.dumps(row, default=plain, option=_OPTION)
    except TypeError:  # keys that are not texts, whole numbers beyond 64 bits, half surrogate pairs
        return json.dumps(plain(row)).encode()


def new_row_file(folder: Path, writer: str) -> Path:
    """Create an empty file, numbered after all existing ones: names sort by time."""
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + max((_number(path) for path in row_files(folder)), default=0)
    while True:
        path = folder / f"{number:06d}-{writer}.jsonl"
        try:
            # Of two writers that chose one number, the file system lets one make the file.
            path.touch(exist_ok=False)
        except FileExistsError:
            number += 1
        else:
            return path


def read_rows(
    folder: Path,
    *,
    start: Mapping[str, tuple[int, int]] | None = None,
    fields: Collection[str] | None = None,
    cells: Collection[str] | None = None,
    hashed: bool = False,
) -> StoredRows:
    """Return all rows of a folder of row files; no content of a file raises.

    `start` gives the (line, offset) behind which a file, by its name, is read; `fields` and `cells`
    those that are kept in memory, where these are not all; `hashed`: every row has its hash.
    """
    rows: dict[str, Row] = {}
    torn = 0
    # Folders, devices, pipes and dangling links are not read.
    garbled = sorted(path.name for path in folder.glob("*.jsonl") if not path.is_file())
    for path in row_files(folder):
        for line in lines(path, *(start or {}).get(path.name, (0, 0))):
            row = parse_row(line.text, hashed=hashed)
            if row is not None:
                if cells is None or row["id"] in cells:
                    # Out first: a row that is computed again stands where it was written last.
                    rows.pop(row["id"], None)
                    kept = ((key, value) for key, value in row.items() if key in (fields or ()))
                    rows[row["id"]] = with_entries(row) if fields is None else dict(kept)
            elif line.unfinished:
                torn += 1
            else:
                garbled.append(f"{path.name}:{line.number}")
    return StoredRows(rows, torn, tuple(garbled))


def rows_with_origin(
    folder: Path, *, hashed: bool = False
) -> Iterator[tuple[Row | bytes, RowStart]]:
    """Yield each row of a folder of row files and its place, one in memory at a time; of a line
    that is not a row its text."""
    for path in row_files(folder):
        for line in lines(path):
            row = parse_row(line.text, hashed=hashed)
            place = RowStart(path, line.end - len(line.text), line.number)
            yield line.text if row is None else with_entries(row), place


def find_row(folder: Path, cell: str, *, hashed: bool = False) -> Row | None:
    """Return the row of one cell, as `read_rows` does."""
    found, written = None, {json.dumps(cell).encode(), _text(cell)}
    for line in chain.from_iterable(map(lines, row_files(folder))):
        is_near = any(text in line.text for text in written)
        row = parse_row(line.text, hashed=hashed) if is_near else None
        if row is not None and row["id"] == cell:
            found = row
    return with_entries(found) if found is not None else None


def stored_rows(path: Path) -> dict[str, Row]:
    """Return the complete rows of one file of this version, none where it is gone."""
    if not path.is_file():
        return {}
    rows = (parse_row(line.text, hashed=True) for line in lines(path))
    return {row["id"]: row for row in rows if row is not None}


def row_files(folder: Path) -> list[Path]:
    """Return the row files of a folder in the order in which they were made."""
    files = filter(Path.is_file, folder.glob("*.jsonl"))
    # As texts, 1000000 would stand before 999999.
    return sorted(files, key=lambda path: (_number(path), path.name))


def _number(path: Path) -> int:
    head = path.name.partition("-")[0]
    return int(head) if head.isdigit() else 0


def lines(path: Path, number: int = 0, offset: int = 0) -> Iterator[Line]:
    """Yield the lines with a text behind a line and its offset, one in memory at a time. The
    text of one with more than LARGEST_ROW bytes, which is not a row, is left out. Raises UsageError
    where the disk gives an error: without these rows the answer would be another."""
    with path.open("rb") as file:
        file.seek(offset)
        while text := _readline(file, LARGEST_ROW):
            number, is_ended = number + 1, text.endswith(b"\n")
            is_long = len(text) == LARGEST_ROW and not is_ended
            if is_long:
                text = b""
                while (part := _readline(file, _BLOCK)) and not part.endswith(b"\n"):
                    pass
                is_ended = part.endswith(b"\n")
            if is_long or text.strip():
                yield Line(number, text, file.tell(), not is_ended)


def _readline(file: IO[bytes], size: int) -> bytes:
    try:
        return file.readline(size)
    except OSError as error:
        raise UsageError(
            f"{file.name!r} cannot be read ({error.strerror}); remove it, and the run computes its "
            "rows again."
        ) from error


def parse_row(line: bytes, *, hashed: bool = False) -> Row | None:
    """Return the row of a line, tables as they were written; None for all that is not a row, or
    another one than was written; where rows are `hashed`, also for one without its hash."""
    text = without_hash(line)
    if hashed and text == line:
        return None
    try:
        row = _json(text)
    except (ValueError, RecursionError):
        return None
    # A hash that does not fit is still there as a field: the row was changed.
    return row if is_row(row) and HASH not in row else None


def _json(text: bytes) -> Any:
    """Return the value of a JSON text as json.loads does, which takes four times as long."""
    from pydantic_core import from_json  # workers, which write alone, do without it

    try:
        return from_json(text)
    except ValueError:  # also half a surrogate pair, and deeper nesting
        return json.loads(text)


def columns_of(table: Any) -> Mapping[str, list[Any]] | None:
    """Return the columns of a table that was written by column; None for any other."""
    return table["columns"] if isinstance(table, dict) else None


def with_entries(row: Row) -> Row:
    """Return the row with its tables as lists of entries."""
    written = {field: columns_of(row.get(field)) for field in TABLES}
    tables = {}
    for name, columns in written.items():
        if columns:
            lines = zip(*columns.values(), strict=True)
            tables[name] = [dict(zip(columns, values, strict=True)) for values in lines]
    return row | tables


@dataclass(eq=False)
class NewRows:
    """Rows below a run folder by id; each line is read once."""

    folder: Path
    rows: dict[str, Row] = field(default_factory=dict)
    _behind: dict[Path, tuple[int, int]] = field(default_factory=dict)

    def update(self) -> None:
        """Read the lines that were completed since the last look."""
        for path in row_files(self.folder / "cells"):
            number, offset = self._behind.get(path, (0, 0))
            for line in lines(path, number, offset):
                # Its writer is in the midst of it; the next look reads the whole line.
                if line.unfinished:
                    break
                self._behind[path] = line.number, line.end
                if (row := parse_row(line.text, hashed=True)) is not None:
                    self.rows[row["id"]] = with_entries(row)
