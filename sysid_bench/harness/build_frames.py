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
from functools import cached_property
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import IO, Any, Final

from sysid_bench.harness.data_frames import FIRST, frame_row
from sysid_bench.harness.frame_files import (
    COVERAGE_FILE,
    FRAMES,
    UNREADABLE,
    Coverage,
    CoveragePart,
    FrameFiles,
    coverage_part,
    frame_hash,
    read_coverage,
)
from sysid_bench.harness.row_counts import RowCounts, RowKind, row_kind
from sysid_bench.harness.work.row_files import (
    TABLES,
    columns_of,
    lines,
    parse_row,
    row_files,
    with_entries,
)
from sysid_bench.input_files import file_hash
from sysid_bench.types import Row

_GROUP: Final = 1000  # cells whose values are in memory at a time
_TABLE_OF: Final = {"parameters": "parameters_table", "joints": "joints"}
_HUGE: Final = 2**63
_LETTERS: Final = {kind.__name__[0]: kind for kind in (bool, int, float, str, NoneType)}

_Columns = dict[str, list[Any]]
"""Values of the columns of a frame."""
_Types = tuple[tuple[str, frozenset[type]], ...]
"""Types of the values of each column of a part of a frame."""
_Kind = tuple[_Types, ...]
"""Types of the parts that a row makes of the frames."""


class _ReplacedRowError(LookupError):
    """A row of a cell that the earlier files hold: they are made anew."""


@dataclass(frozen=True)
class PlannedFields:
    """First fields of every cell by id, in the order of the plan, and its `RowKind.cell`; `hashed`:
    rows of the run have a hash."""

    fields: Mapping[str, Row]
    places: Mapping[str, int]
    hashed: bool = False


def build_frames(folder: Path, heads: PlannedFields, out: Path | None = None) -> Coverage:
    """Write the Parquet files of a run and what they cover, to another folder where `out` is given.

    Rows that the present files hold are taken from them. Files are replaced whole; for the folder
    of the run the caller holds its lock. Raises OSError.
    """
    earlier = read_coverage(folder, row_files(folder / "cells"))
    if earlier is not None:
        with suppress(*UNREADABLE):
            return _consolidate(folder, heads, out, earlier)
    return _consolidate(folder, heads, out, None)


def _consolidate(
    folder: Path, heads: PlannedFields, out: Path | None, earlier: Coverage | None
) -> Coverage:
    """Consolidate from the start, or behind what the `earlier` files hold; raise what they raise,
    and ValueError or LookupError where new rows change their rows or types."""
    target = out or folder
    plan = file_hash(folder / "plan.jsonl")
    with ExitStack() as stack:
        copy = stack.enter_context(tempfile.TemporaryFile(dir=target))
        files = FrameFiles(folder, earlier) if earlier else None
        paths = row_files(folder / "cells")
        rows = _Scan(heads, paths, copy, earlier, _ids(files))
        rows.read()
        text = _part_file(target, COVERAGE_FILE)
        if earlier and out is None and not rows.places:
            footers = earlier.footers
            parts = dict[str, Path]()
        else:
            parts = {name: _part_file(target, f"{name}.parquet") for name in FRAMES}
            for part in parts.values():
                stack.callback(part.unlink, missing_ok=True)
            _write_parts(rows, parts, files)
            footers = {name: frame_hash(part) for name, part in parts.items()}
        parts_of_text = tuple(rows.garbled), rows.kinds_to_json(), rows.counts()
        coverage = Coverage(footers, plan, rows.covered, *parts_of_text)
        text.write_text(coverage.to_json(), encoding="utf-8")
        for name, part in parts.items():
            part.replace(target / f"{name}.parquet")
        text.replace(target / COVERAGE_FILE)
    return coverage


def _ids(files: FrameFiles | None) -> frozenset[str]:
    return frozenset(files.fields_of_rows(["id"])) if files else frozenset()


def _part_file(folder: Path, name: str) -> Path:
    """Return the file beside a file that will replace it; remove those of killed processes."""
    for old in folder.glob(f".{name}.*"):
        with suppress(OSError):
            old.unlink()
    return folder / f".{name}.{os.getpid()}"


@dataclass
class _Scan:
    """Places of the last rows of the planned cells in the copy, and the types of their columns."""

    planned: PlannedFields
    paths: Sequence[Path]
    copy: IO[bytes]
    earlier: Coverage | None = None
    stored: frozenset[str] = frozenset()  # cells of the earlier files
    places: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # start, size, types
    types: dict[_Kind, int] = field(default_factory=dict)
    counted: dict[str, RowKind] = field(default_factory=dict)
    row_kinds: dict[RowKind, RowKind] = field(default_factory=dict)  # one of equal ones
    covered: dict[str, CoveragePart] = field(default_factory=dict)
    garbled: list[str] = field(default_factory=list)

    @property
    def heads(self) -> Mapping[str, Row]:
        """First fields of every cell."""
        return self.planned.fields

    def read(self) -> None:
        """Read all row files, behind what the earlier files hold, up to their last whole row."""
        start = self.earlier.start if self.earlier else {}
        self.garbled += self.earlier.garbled if self.earlier else ()
        for path in self.paths:
            changed, (count, end) = path.stat().st_mtime_ns, start.get(path.name, (0, 0))
            for line in lines(path, count, end):
                if not self._take(line.text):
                    if line.unfinished:
                        break  # it may become a row
                    self.garbled.append(f"{path.name}:{line.number}")
                end, count = line.end, line.number
            self.covered[path.name] = coverage_part(path, end, count, changed)

    def _take(self, text: bytes) -> bool:
        """Copy a row; False for a line that is not a row."""
        row = parse_row(text, hashed=self.planned.hashed)
        if row is None:
            return False
        if row["id"] in self.stored:
            raise _ReplacedRowError(row["id"])
        if row["id"] in self.heads:
            kind = row_kind(row, self.planned.places[row["id"]])
            self.counted[row["id"]] = self.row_kinds.setdefault(kind, kind)
            parts = self._frames_of(row)
            types = tuple(map(_types, parts.values()))
            number = self.types.setdefault(types, len(self.types))
            start = self.copy.tell()
            self.places[row["id"]] = start, self.copy.write(marshal.dumps(parts)), number
        return True

    def counts(self) -> RowCounts | None:
        """Counts of all rows, of the earlier ones as they were stored."""
        before = self.earlier.counts if self.earlier else RowCounts(len(self.heads), {})
        counts = before and before.with_rows(self.counted.values())
        return counts if counts and counts.is_bounded else None

    @cached_property
    def kinds(self) -> dict[_Kind, str]:
        """Types of rows, each with its first cell in the order of the plan, in that order."""
        order = {cell: number for number, cell in enumerate(self.heads)}
        types = list(self.types)
        pairs = [(cell, types[self.places[cell][2]]) for cell in self.heads if cell in self.places]
        for cell, written in self.earlier.kinds if self.earlier else ():
            pairs.append((cell, tuple(_types_of(part) for part in written)))
        first: dict[_Kind, str] = {}
        for cell, kind in sorted(pairs, key=lambda pair: order[pair[0]]):
            first.setdefault(kind, cell)
        return first

    def kinds_to_json(self) -> tuple[Any, ...]:
        """Kinds as consolidated.json has them: the types of a column are letters."""
        return tuple(
            [cell, [[[name, _letters(types)] for name, types in part] for part in kind]]
            for kind, cell in self.kinds.items()
        )

    def _frames_of(self, row: Row) -> dict[str, _Columns]:
        """Part of each frame that a row makes."""
        row = row | self.heads[row["id"]]
        cell = frame_row({key: value for key, value in row.items() if key not in TABLES})
        parts = {name: _long_columns(row, table) for name, table in _TABLE_OF.items()}
        return {"cells": {key: [value] for key, value in cell.items()}, **parts}

    def columns(self, frame: str) -> dict[str, frozenset[type]]:
        """Types of each column of a frame, in the order in which the rows name them."""
        parts = [dict(kind[FRAMES.index(frame)]) for kind in self.kinds]
        names = dict.fromkeys((*FIRST[frame], *(name for part in parts for name in part)))
        absent = frozenset({NoneType})
        return {
            name: frozenset().union(*(part.get(name, absent) for part in parts if part))
            for name in names
        }

    def groups(self) -> Iterator[tuple[list[str], dict[str, _Columns]]]:
        """Cells in the order of the plan, some at a time, with the values of those that are new."""
        names = {frame: self.columns(frame) for frame in FRAMES}
        left = (cell for cell in self.heads if cell in self.places or cell in self.stored)
        while cells := list(islice(left, _GROUP)):
            group: dict[str, _Columns] = {f: {n: [] for n in names[f]} for f in FRAMES}
            for cell in filter(self.places.__contains__, cells):
                start, size, _ = self.places[cell]
                self.copy.seek(start)
                for frame, part in marshal.loads(self.copy.read(size)).items():
                    _extend(group[frame], part)
            yield cells, group


def _long_columns(row: Row, field: str) -> _Columns:
    """Columns of a table of a row, nested values as `flat` makes them."""
    columns = columns_of(row.get(field))
    if columns is None or any({dict, list} & set(map(type, c)) for c in columns.values()):
        entries = [
            {"id": row["id"], **frame_row(entry)} for entry in with_entries(row).get(field) or ()
        ]
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


def _letters(types: Iterable[type]) -> str:
    return "".join(sorted(kind.__name__[0] for kind in types))


def _types_of(written: Iterable[Sequence[str]]) -> _Types:
    return tuple((name, frozenset(map(_LETTERS.__getitem__, letters))) for name, letters in written)


def _write_parts(rows: _Scan, parts: Mapping[str, Path], files: FrameFiles | None) -> None:
    """Write the frames to their files, a group of rows at a time."""
    from sysid_bench.harness import frame_writer

    columns = {frame: rows.columns(frame) for frame in FRAMES}
    kept = frame_writer.StoredFrames(files.files) if files else None
    frame_writer.write_frames(parts, columns, rows.groups(), kept)
