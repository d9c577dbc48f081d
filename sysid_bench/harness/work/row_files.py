"""Row files: append-only JSON lines, one writer per file; of rows with one id the last holds."""

import contextlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from sysid_bench.canonical_json import plain
from sysid_bench.harness.work.row_check import is_row, not_files
from sysid_bench.types import Row

SYNC_SECONDS = 1.0
"""Interval of fsync; once per row would cost four times as much as writing it."""


@dataclass(frozen=True)
class StoredRows:
    """The last row of every id. `torn` counts unfinished last lines of writers that were killed;
    `garbled` lists every other line that is not a row ("file:line")."""

    rows: dict[str, Row]
    torn: int
    garbled: tuple[str, ...]


class RowWriter:
    """Appends rows to its own file; once `append` returns, the operating system holds the row."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("ab", buffering=0)
        self._synced = time.monotonic()

    def write(self, row: Row) -> None:
        """Append one line. Raises TypeError before writing for values that are not JSON."""
        self._append(json.dumps(plain(row)).encode() + b"\n")
        if time.monotonic() - self._synced > SYNC_SECONDS:
            self._sync()

    def _append(self, line: bytes) -> None:
        """Append all or nothing: a full disk may take a part of a line."""
        start = self._file.tell()
        try:
            while line:
                line = line[self._file.write(line) :]
        except OSError:
            self._file.truncate(start)
            raise

    def close(self) -> None:
        """Force the rest to the disk; closing twice is allowed. What a full disk does not take has
        been reported by `write`."""
        with contextlib.suppress(OSError):
            if not self._file.closed:
                self._sync()
        self._file.close()

    def __enter__(self) -> "RowWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced = time.monotonic()


def new_row_file(folder: Path, writer: str) -> Path:
    """Create an empty file, numbered after all existing ones: names sort by time."""
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + max((_number(path) for path in _files(folder)), default=0)
    while True:
        path = folder / f"{number:06d}-{writer}.jsonl"
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            number += 1
        else:
            return path


def read_rows(folder: Path) -> StoredRows:
    """Return all rows of a folder of row files; no content of a file raises."""
    rows: dict[str, Row] = {}
    torn, garbled = 0, not_files(folder, "*.jsonl")
    for path in _files(folder):
        for number, line, last in _lines(path):
            row = _row(line)
            if row is not None:
                rows.pop(row["id"], None)
                rows[row["id"]] = row
            elif last:
                torn += 1
            else:
                garbled.append(f"{path.name}:{number}")
    return StoredRows(rows, torn, tuple(garbled))


def stored_rows(path: Path) -> dict[str, Row]:
    """Return the complete rows of one file, none where it is gone."""
    if not path.is_file():
        return {}
    rows = (_row(line) for _, line, _ in _lines(path))
    return {row["id"]: row for row in rows if row is not None}


def _files(folder: Path) -> list[Path]:
    files = filter(Path.is_file, folder.glob("*.jsonl"))
    return sorted(files, key=lambda path: (_number(path), path.name))


def _number(path: Path) -> int:
    head = path.name.partition("-")[0]
    return int(head) if head.isdigit() else 0


def _lines(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Yield (number, line, True for an unfinished last line)."""
    pieces = path.read_bytes().split(b"\n")
    for number, line in enumerate(pieces, 1):
        if line.strip():
            yield number, line, number == len(pieces)


def _row(line: bytes) -> Row | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if is_row(row) else None
