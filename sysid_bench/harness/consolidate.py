"""Consolidation: the rows of a run become its Parquet files, in bounded memory.

Rows are copied to a temporary file first, for the types of all columns and the last row of each
cell; then they are written in the order of the plan, in groups. The copy is binary: JSON is parsed
ten times as slowly.
"""

import marshal
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import IO, TYPE_CHECKING, Any, Final

from sysid_bench.harness.data_frames import FIRST, flat
from sysid_bench.harness.frame_files import (
    COVERAGE_FILE,
    FRAMES,
    Coverage,
    CoveredFile,
    covered_file,
    footer_hash,
)
from sysid_bench.harness.work.row_check import TABLES
from sysid_bench.harness.work.row_files import (
    columns_of,
    lines,
    parse_row,
    row_files,
    with_entries,
)
from sysid_bench.input_files import file_hash
from sysid_bench.types import Row

if TYPE_CHECKING:
    pass

_GROUP: Final = 1000  # cells whose values are in memory at a time
_TABLE_OF: Final = {"parameters": "parameters_table", "joints": "joints"}
_HUGE: Final = 2**63

_Columns = dict[str, list[Any]]
"""Values of the columns of a frame."""
_Types = tuple[tuple[str, frozenset[type]], ...]
"""Types of the values of each column of a part of a frame."""


def consolidate(folder: Path, heads: Mapping[str, Row], out: Path | None = None) -> Coverage:
    """Write the Parquet files of a run and what they cover, to another folder where `out` is given.

    `heads` are the first fields of every cell, in the order of the plan. Files are replaced whole;
    for the folder of the run the caller holds its lock. Raises OSError.
    """
    target = out or folder
    plan = file_hash(folder / "plan.jsonl")
    with ExitStack() as stack:
        copy = stack.enter_context(tempfile.TemporaryFile(dir=target))
        rows = _Scan(heads, row_files(folder / "cells"), copy)
        rows.read()
        parts = {name: _part_file(target, f"{name}.parquet") for name in FRAMES}
        for part in parts.values():
            stack.callback(part.unlink, missing_ok=True)
        _write_parts(rows, parts)
        footers = {name: footer_hash(part) for name, part in parts.items()}
        coverage = Coverage(footers, plan, rows.covered, tuple(rows.garbled))
        text = _part_file(target, COVERAGE_FILE)
        text.write_text(coverage.to_json(), encoding="utf-8")
        for name, part in parts.items():
            part.replace(target / f"{name}.parquet")
        text.replace(target / COVERAGE_FILE)
    return coverage


def _part_file(folder: Path, name: str) -> Path:
    """Return the file beside a file that will replace it; remove those of killed processes."""
    for old in folder.glob(f".{name}.*"):
        with suppress(OSError):
            old.unlink()
    return folder / f".{name}.{os.getpid()}"


@dataclass
class _Scan:
    """Places of the last rows of the planned cells in the copy, and the types of their columns."""

    heads: Mapping[str, Row]
    paths: Sequence[Path]
    copy: IO[bytes]
    places: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # start, size, types
    types: dict[tuple[_Types, ...], int] = field(default_factory=dict)
    covered: dict[str, CoveredFile] = field(default_factory=dict)
    garbled: list[str] = field(default_factory=list)

    def read(self) -> None:
        """Read all row files up to their last whole row."""
        for path in self.paths:
            changed, end, count = path.stat().st_mtime_ns, 0, 0
            for line in lines(path):
                if not self._take(line.text):
                    if line.unfinished:
                        break  # it may become a row
                    self.garbled.append(f"{path.name}:{line.number}")
                end, count = line.end, line.number
            self.covered[path.name] = covered_file(path, end, count, changed)

    def _take(self, text: bytes) -> bool:
        """Copy a row; False for a line that is not a row."""
        row = parse_row(text)
        if row is None:
            return False
        if row["id"] in self.heads:
            parts = self._frames_of(row)
            types = tuple(map(_types, parts.values()))
            number = self.types.setdefault(types, len(self.types))
            start = self.copy.tell()
            self.places[row["id"]] = start, self.copy.write(marshal.dumps(parts)), number
        return True

    def _frames_of(self, row: Row) -> dict[str, _Columns]:
        """Part of each frame that a row makes."""
        row = row | self.heads[row["id"]]
        cell = flat({key: value for key, value in row.items() if key not in TABLES})
        parts = {name: _long_columns(row, table) for name, table in _TABLE_OF.items()}
        return {"cells": {key: [value] for key, value in cell.items()}, **parts}

    def columns(self, frame: str) -> dict[str, frozenset[type]]:
        """Types of each column of a frame, in the order in which the rows name them."""
        kinds = list(self.types)
        used = dict.fromkeys(self.places[cell][2] for cell in self.heads if cell in self.places)
        parts = [dict(kinds[kind][FRAMES.index(frame)]) for kind in used]
        names = dict.fromkeys((*FIRST[frame], *(name for part in parts for name in part)))
        absent = frozenset({NoneType})
        return {
            name: frozenset().union(*(part.get(name, absent) for part in parts if part))
            for name in names
        }

    def groups(self) -> Iterator[dict[str, _Columns]]:
        """Values of the frames in the order of the plan, some rows at a time."""
        names = {frame: self.columns(frame) for frame in FRAMES}
        left = filter(self.places.__contains__, self.heads)
        while cells := list(islice(left, _GROUP)):
            group: dict[str, _Columns] = {f: {n: [] for n in names[f]} for f in FRAMES}
            for cell in cells:
                start, size, _ = self.places[cell]
                self.copy.seek(start)
                for frame, part in marshal.loads(self.copy.read(size)).items():
                    _extend(group[frame], part)
            yield group


def _long_columns(row: Row, field: str) -> _Columns:
    """Columns of a table of a row, nested values as `flat` makes them."""
    columns = columns_of(row.get(field))
    if columns is None or any({dict, list} & set(map(type, c)) for c in columns.values()):
        entries = [{"id": row["id"], **flat(entry)} for entry in with_entries(row).get(field) or ()]
        names = dict.fromkeys(name for entry in entries for name in entry)
        return {name: [entry.get(name) for entry in entries] for name in names}
    size = len(next(iter(columns.values())))
    return {"id": [row["id"]] * size, **columns} if size else {}


def _types(columns: _Columns) -> _Types:
    return tuple([(name, _kinds(values)) for name, values in columns.items()])


def _kinds(values: Iterable[Any]) -> frozenset[type]:
    """Types of values; a whole number beyond 64 bits counts as a text, too."""
    kinds = set(map(type, values))
    if int in kinds and any(type(v) is int and abs(v) >= _HUGE for v in values):
        kinds.add(str)
    return frozenset(kinds)


def _extend(group: _Columns, part: _Columns) -> None:
    """Append a row's part, None in the columns that it lacks."""
    size = max(map(len, part.values()), default=0)
    for name, values in group.items():
        values += part.get(name) or [None] * size


def _write_parts(rows: _Scan, parts: Mapping[str, Path]) -> None:
    """Write the frames to their files, a group of rows at a time."""
    from sysid_bench.harness.frame_writer import write_frames

    write_frames(parts, {frame: rows.columns(frame) for frame in FRAMES}, rows.groups())
