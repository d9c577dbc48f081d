"""Consolidation: the rows of a run as Parquet files, written in bounded memory.

Rows are copied to a temporary file first, for the types of all columns and the last row of each
cell; then they are written in the order of the plan, in groups.
"""

import marshal
import os
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np

from sysid_bench.harness.coverage import (
    COVERAGE_FILE,
    UNREADABLE,
    Coverage,
    CoveragePart,
    FrameFiles,
    RowCounts,
    RowKind,
    footer_hash,
    read_coverage,
    start_hash,
)
from sysid_bench.harness.frames import (
    FRAMES,
    Columns,
    Kind,
    kind_of,
    parts_of,
    schemas_of,
    table_of,
)
from sysid_bench.harness.work.row_files import lines, parse_row, row_files
from sysid_bench.input_files import file_hash
from sysid_bench.types import Row

if TYPE_CHECKING:
    import pyarrow

_GROUP: Final = 1000  # cells whose values are in memory at a time
_MOST_KINDS: Final = 10_000
"""Kinds of rows that are counted in consolidated.json: reasons may differ in every row."""
_LETTERS: Final = {kind.__name__[0]: kind for kind in (bool, int, float, str, NoneType)}


@dataclass(frozen=True)
class PlannedFields:
    """First fields of every cell by id, in the order of the plan, and its `RowKind.cell`; `hashed`:
    rows of the run have a hash."""

    fields: Mapping[str, Row]
    places: Mapping[str, int]
    hashed: bool = False


class _ReplacedRowError(LookupError):
    """A row of a cell that the earlier files hold: they are made anew."""


def build_frames(folder: Path, planned: PlannedFields, out: Path | None = None) -> Coverage:
    """Write the Parquet files of a run and what they cover, to another folder where `out` is given.

    Rows that the present files hold are taken from them. Files are replaced whole; for the folder
    of the run the caller holds its lock. Raises OSError.
    """
    earlier = read_coverage(folder, row_files(folder / "cells"))
    if earlier is not None:
        with suppress(*UNREADABLE):
            return _consolidate(folder, planned, out, earlier)
    return _consolidate(folder, planned, out, None)


def _consolidate(
    folder: Path, planned: PlannedFields, out: Path | None, earlier: Coverage | None
) -> Coverage:
    """Consolidate from the start, or behind what the `earlier` files hold; raise what they raise,
    and ValueError or LookupError where new rows change their rows or types."""
    target = out or folder
    plan = file_hash(folder / "plan.jsonl")
    with ExitStack() as stack:
        # On disk: with the rows of 10,000 cells in memory, the end of a run took 1.8 GB.
        copy = stack.enter_context(tempfile.TemporaryFile(dir=target))
        files = FrameFiles(folder, earlier) if earlier else None
        scan = _Scan(planned, copy, earlier, files)
        covered = scan.read(row_files(folder / "cells"))
        text = _part_file(target, COVERAGE_FILE)
        parts = {name: _part_file(target, f"{name}.parquet") for name in FRAMES}
        # Nothing new: the files stay, and only what they cover is stated anew.
        if earlier and out is None and not scan.places:
            footers, parts = earlier.footers, {}
        else:
            for part in parts.values():
                stack.callback(part.unlink, missing_ok=True)
            _write_parts(scan, parts, files)
            footers = {name: footer_hash(part) for name, part in parts.items()}
        kinds = scan.kinds_to_json()
        coverage = Coverage(footers, plan, covered, tuple(scan.garbled), kinds, scan.counts())
        text.write_text(coverage.to_json(), encoding="utf-8")
        for name, part in parts.items():
            part.replace(target / f"{name}.parquet")
        # Last. Between the two, readers find footers that are not those stated, and read the rows.
        text.replace(target / COVERAGE_FILE)
    return coverage


def _part_file(folder: Path, name: str) -> Path:
    """Return the file beside a file that will replace it; remove those of killed processes."""
    # The caller holds the lock of the run, so that none of them is being written.
    for old in folder.glob(f".{name}.*"):
        with suppress(OSError):
            old.unlink()
    return folder / f".{name}.{os.getpid()}"


class _Scan:
    """Last rows of the planned cells in a binary copy, which is read ten times as fast as JSON, and
    the types of their columns."""

    def __init__(
        self,
        planned: PlannedFields,
        copy: IO[bytes],
        earlier: Coverage | None,
        files: FrameFiles | None,
    ) -> None:
        self.places: dict[str, tuple[int, int, int]] = {}  # cell -> start, size, number of kind
        self.garbled = list(earlier.garbled) if earlier else []
        self._planned, self._copy, self._earlier = planned, copy, earlier
        self._stored = files.ids if files else frozenset[str]()
        self._kinds: dict[Kind, int] = {}
        self._counted: dict[str, RowKind] = {}
        self._row_kinds: dict[RowKind, RowKind] = {}  # one of equal ones, for the memory

    def read(self, paths: Iterable[Path]) -> dict[str, CoveragePart]:
        """Read row files, behind what the earlier files hold, up to their last whole row; return
        what is covered of each."""
        start, covered = self._earlier.start if self._earlier else {}, {}
        for path in paths:
            # The time before it is read: a change while it is read is seen the next time.
            changed, (count, end) = path.stat().st_mtime_ns, start.get(path.name, (0, 0))
            for line in lines(path, count, end):
                row = parse_row(line.text, hashed=self._planned.hashed)
                if row is not None:
                    self._take_row(row)
                elif line.unfinished:
                    break  # it may become a row
                else:
                    self.garbled.append(f"{path.name}:{line.number}")
                end, count = line.end, line.number
            covered[path.name] = CoveragePart(end, count, start_hash(path, end), changed)
        return covered

    def _take_row(self, row: Row) -> None:
        """Copy a row of a planned cell."""
        cell = row["id"]
        if cell in self._stored:
            raise _ReplacedRowError(cell)
        if cell in self._planned.fields:
            counted = RowKind.of(row, self._planned.places[cell])
            self._counted[cell] = self._row_kinds.setdefault(counted, counted)
            parts = parts_of(row | self._planned.fields[cell])
            # The types of all rows are needed before the first line of a Parquet file.
            number = self._kinds.setdefault(kind_of(parts), len(self._kinds))
            start = self._copy.tell()
            # marshal is safe here: the file is this process's own, and gone with it.
            self.places[cell] = start, self._copy.write(marshal.dumps(parts)), number

    def counts(self) -> RowCounts | None:
        """Counts of all rows, of the earlier ones as they were stored."""
        before = self._earlier.counts if self._earlier else RowCounts(len(self._planned.fields), {})
        new = self._counted.values()
        counts = before and RowCounts(before.cells, Counter(before.rows) + Counter(new))
        return counts if counts and len(counts.rows) <= _MOST_KINDS else None

    @cached_property
    def kinds(self) -> dict[Kind, str]:
        """Kinds of rows, each with its first cell in the order of the plan, in that order."""
        order = {cell: number for number, cell in enumerate(self._planned.fields)}
        kinds = list(self._kinds)
        pairs = [(cell, kinds[self.places[cell][2]]) for cell in order if cell in self.places]
        for cell, written in self._earlier.kinds if self._earlier else ():
            kind = [
                tuple([(name, frozenset(_LETTERS[one] for one in types)) for name, types in part])
                for part in written
            ]
            pairs.append((cell, tuple(kind)))
        first: dict[Kind, str] = {}
        for cell, found in sorted(pairs, key=lambda pair: order[pair[0]]):
            first.setdefault(found, cell)
        return first

    def kinds_to_json(self) -> tuple[Any, ...]:
        """Kinds as consolidated.json has them: the types of a column are letters."""
        written = []
        for kind, cell in self.kinds.items():
            letters = [
                [[name, "".join(sorted(one.__name__[0] for one in types))] for name, types in part]
                for part in kind
            ]
            written.append([cell, letters])
        return tuple(written)

    def groups(self) -> Iterator[tuple[list[str], list[dict[str, Columns]]]]:
        """Cells in the order of the plan, some at a time, with the parts of those that are new."""
        left = (c for c in self._planned.fields if c in self.places or c in self._stored)
        while cells := list(islice(left, _GROUP)):
            group = []
            for cell in filter(self.places.__contains__, cells):
                start, size, _ = self.places[cell]
                self._copy.seek(start)
                group.append(marshal.loads(self._copy.read(size)))
            yield cells, group


def _write_parts(scan: _Scan, paths: Mapping[str, Path], files: FrameFiles | None) -> None:
    """Write the frames to their files, a group of rows at a time. Raises ValueError where the
    columns of earlier `files` have other types now."""
    from pyarrow import parquet

    schemas = schemas_of(scan.kinds)
    if files is not None:
        files.check_types(schemas)
    # With checksums a damaged page is an error, and not another number.
    # 10,000 rows took 12 MB and 0.1 s to read, as JSON lines 36 MB and 1 to 2 s.
    options = {"compression": "zstd", "write_page_checksum": True}
    with ExitStack() as stack:
        writers = {
            frame: stack.enter_context(parquet.ParquetWriter(paths[frame], schema, **options))
            for frame, schema in schemas.items()
        }
        for cells, group in scan.groups():
            earlier = files.take_cells(cells) if files else {}
            for frame, schema in schemas.items():
                table = table_of([parts[frame] for parts in group], schema)
                if frame in earlier:
                    table = _joined(earlier[frame], table, cells)
                writers[frame].write_table(table, row_group_size=max(1, table.num_rows))


def _joined(old: "pyarrow.Table", new: "pyarrow.Table", cells: Sequence[str]) -> "pyarrow.Table":
    """Lines of two tables with the columns of the second, in the order of the cells."""
    import pyarrow

    columns = [
        # Not safe: a whole number beyond 2**53 is rounded as a new row's is, and not refused.
        old[field.name].cast(field.type, safe=False)
        if field.name in old.column_names
        else pyarrow.nulls(old.num_rows, field.type)
        for field in new.schema
    ]
    table = pyarrow.concat_tables([pyarrow.Table.from_arrays(columns, schema=new.schema), new])
    if not (old.num_rows and new.num_rows):
        return table
    place = {cell: number for number, cell in enumerate(cells)}
    # Stable, so that the joints and parameters of a cell keep their order.
    return table.take(np.argsort([place[cell] for cell in table["id"].to_pylist()], kind="stable"))
