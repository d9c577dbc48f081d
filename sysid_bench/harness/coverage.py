"""What the Parquet files of a run hold: cells.parquet, parameters.parquet and joints.parquet.

consolidated.json states up to which byte of each row file the three files hold the rows, and the
hashes of their footers, and counts these rows. Readers use them where all of that is true and the
file is as it was written; else the row files decide.
"""

import hashlib
import json
import os
import sys
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from sysid_bench.canonical_json import canonical
from sysid_bench.harness.frames import FRAMES, columns_of_fields, pandas_frame
from sysid_bench.input_files import LARGEST_HASHED, check_file, file_hash, parse_json, read_text
from sysid_bench.types import Row

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow

COVERAGE_FILE: Final = "consolidated.json"
UNREADABLE: Final = (
    *(OSError, ValueError, LookupError, TypeError, NotImplementedError),
    ImportError,  # without the extra `parquet` the row files decide
)
"""Errors of reading a Parquet file that is absent or damaged."""
HEAD: Final = ("id", "status", "reason", "crosscheck", "fingerprint", "losses", "sources")
"""Fields of a row on which the next run, its result and the status of a run depend."""

_FORMAT: Final = 3
_HASH: Final = "sha256"
"""First key of consolidated.json: hash of the text behind it."""
_BLOCK: Final = 1 << 20


class FrameFiles:
    """Open Parquet files of one consolidation; they stay readable when others replace them."""

    def __init__(self, folder: Path, coverage: "Coverage") -> None:
        """Raise OSError or ValueError where a file is absent, damaged or of another one."""
        import pyarrow.parquet

        self._files: dict[str, Any] = {}
        for name in FRAMES:
            path = folder / f"{name}.parquet"
            check_file(path, LARGEST_HASHED)
            self._files[name] = pyarrow.parquet.ParquetFile(path, page_checksum_verification=True)
            if footer_hash(path) != coverage.footers.get(name):
                raise ValueError(f"{path} is not of this consolidation.")
        self._next_group = 0
        self._left = {name: file.schema_arrow.empty_table() for name, file in self._files.items()}

    @cached_property
    def ids(self) -> frozenset[str]:
        """Cells of which the files hold the row."""
        return frozenset(self._table("cells", ["id"])["id"].to_pylist())

    def read(self, name: str, fields: Collection[str] | None = None) -> "pd.DataFrame":
        """Return a frame, or the columns of some fields that are there, as rows give it."""
        return pandas_frame(self._table(name, fields))

    def fields_of_rows(self, fields: Collection[str]) -> dict[str, Row]:
        """Return some fields of all rows, by id, without those that a row does not have."""
        table = self._table("cells", fields)
        heads: list[Row] = [{} for _ in range(table.num_rows)]
        for name in table.column_names:
            column = table.column(name)
            values = column.to_pylist()  # to_numpy would load pandas
            if column.type == "double":  # whole numbers that stand among None are whole again
                values = [int(v) if v is not None and v.is_integer() else v for v in values]
            field, _, key = name.partition(".")  # "a.b" is the key b of the field a
            for head, value in zip(heads, values, strict=True):
                if value is not None and key:
                    head.setdefault(field, {})[key] = value
                elif value is not None:
                    head[field] = value
        return {head["id"]: head for head in heads}

    def _table(self, name: str, fields: Collection[str] | None) -> "pyarrow.Table":
        file = self._files[name]
        columns = columns_of_fields(fields, file.schema_arrow.names)
        return file.read(columns=columns, use_threads=False)

    def check_types(self, schemas: Mapping[str, "pyarrow.Schema"]) -> None:
        """Raise ValueError where the values would be others in columns of these types."""
        for frame, file in self._files.items():
            for column in file.schema_arrow:
                found, wanted = column.type, schemas[frame].field(column.name).type
                # A wider column holds the same values; texts would need the numbers' digits.
                is_wider = found == "int64" and wanted == "double"
                if not (found == wanted or found == "null" or is_wider):
                    raise ValueError(f"{column.name!r} changes from {found} to {wanted}.")

    def take_cells(self, cells: Sequence[str]) -> dict[str, "pyarrow.Table"]:
        """Return the lines of each frame of those of the next cells that the files hold, nothing
        where they hold none. The files are read once, from their begin to their end."""
        import pyarrow
        from pyarrow import compute

        stored = [cell for cell in cells if cell in self.ids]
        while self._left["cells"].num_rows < len(stored):
            for frame, file in self._files.items():
                group = file.read_row_group(self._next_group, use_threads=False)
                self._left[frame] = pyarrow.concat_tables([self._left[frame], group])
            self._next_group += 1
        taken = {}
        wanted = pyarrow.array(stored, pyarrow.string())
        for frame, left in self._left.items() if stored else ():
            count = compute.sum(compute.is_in(left["id"], wanted)).as_py() if left.num_rows else 0
            taken[frame], self._left[frame] = left.slice(0, count), left.slice(count)
        return taken


class RowKind(NamedTuple):
    """Values shared by rows that are counted together. `cell` is the offset (bytes) in plan.jsonl
    of a cell with their code and models, `sources` the canonical JSON of what they loaded."""

    cell: int
    status: str
    reason: str
    fingerprint: str
    sources: str

    @classmethod
    def of(cls, row: Row, place: int) -> "RowKind":
        """Return the kind of a row, or of its fields HEAD, of a cell at a place of the plan."""
        texts = (str(row.get(key) or "") for key in ("status", "reason", "fingerprint"))
        status, reason, code = map(sys.intern, texts)  # of a million rows few are different
        sources = canonical(row["sources"]) if row.get("sources") else ""
        return cls(place, status, reason, code, sources)


@dataclass(frozen=True)
class RowCounts:
    """Numbers of the cells of a plan, and of their rows by kind. A consolidation stores them, so
    that the status of many rows reads no row."""

    cells: int
    rows: Mapping[RowKind, int]

    @classmethod
    def of(cls, places: Mapping[str, int], rows: Mapping[str, Row]) -> "RowCounts":
        """Count the rows, by id, of planned cells; `places` are the `RowKind.cell` of all."""
        kinds = (RowKind.of(rows[cell], place) for cell, place in places.items() if cell in rows)
        return cls(len(places), Counter(kinds))


@dataclass(frozen=True)
class CoveragePart:
    """The covered part of a row file: its bytes, lines and sha256; `mtime` (ns) of the whole."""

    bytes: int
    lines: int
    sha256: str
    mtime: int

    def holds(self, path: Path) -> bool:
        """True where the file still begins with the covered part."""
        try:
            state = path.stat()
            # Nothing was appended or changed: the hash, which reads it all, is not needed.
            if (state.st_size, state.st_mtime_ns) == (self.bytes, self.mtime):
                return True
            return state.st_size >= self.bytes and start_hash(path, self.bytes) == self.sha256
        except OSError:
            return False


@dataclass(frozen=True)
class Coverage:
    """Rows that the Parquet files hold: a part of each row file, with the labels of a plan.
    `footers` are the sha256 of the ends of the files, which describe and number their contents;
    `kinds` are [first cell, types of the columns of each frame] of the rows; `counts` count them,
    None where they are of too many kinds.
    """

    footers: Mapping[str, str]
    plan: str
    files: Mapping[str, CoveragePart]
    garbled: tuple[str, ...]
    kinds: tuple[Any, ...] = ()
    counts: RowCounts | None = None
    format: int = _FORMAT

    @property
    def start(self) -> dict[str, tuple[int, int]]:
        """(line, offset) behind which each row file is not covered."""
        return {name: (file.lines, file.bytes) for name, file in self.files.items()}

    def to_json(self) -> str:
        """Text of consolidated.json, with a line for each entry of a long list."""
        counts = None
        if self.counts is not None:
            rows = [[*kind, count] for kind, count in self.counts.rows.items()]
            counts = {"cells": self.counts.cells, "rows": rows}
        texts = []
        for key, value in {**asdict(replace(self, counts=None)), "counts": counts}.items():
            written = json.dumps(value)
            if isinstance(value, tuple):
                written = "[" + ",".join(f"\n{json.dumps(entry)}" for entry in value) + "]"
            texts.append(f"{json.dumps(key)}: {written}")
        text = ",\n".join(texts) + "\n}\n"
        return f'{{"{_HASH}": "{hashlib.sha256(text.encode()).hexdigest()}",\n{text}'


def read_coverage(folder: Path, paths: Sequence[Path]) -> Coverage | None:
    """Return the coverage of a run folder's Parquet files; None where it is absent or not true:
    its text or the plan was changed, or a row file does not begin with its covered part any more.
    """
    try:
        text = read_text(folder / COVERAGE_FILE)
        data = parse_json(text)
        if data.pop(_HASH) != hashlib.sha256(text.partition("\n")[2].encode()).hexdigest():
            return None
        files = {name: CoveragePart(**file) for name, file in data.pop("files").items()}
        counts = data.pop("counts")
        if counts is not None:
            kinds = {RowKind(*kind): count for *kind, count in counts["rows"]}
            counts = RowCounts(counts["cells"], kinds)
        data |= {key: tuple(data[key]) for key in ("garbled", "kinds")}
        coverage = Coverage(**data, files=files, counts=counts)
        is_true = coverage.format == _FORMAT and coverage.plan == file_hash(folder / "plan.jsonl")
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    present = {path.name: path for path in paths}
    is_true = is_true and all(n in present and file.holds(present[n]) for n, file in files.items())
    return coverage if is_true else None


def footer_hash(path: Path) -> str:
    """Return the sha256 of the footer of a Parquet file, with its length and the magic number."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 8, 0))
        length = int.from_bytes(file.read(4), "little") + 8
        file.seek(max(size - length, 0))
        return hashlib.sha256(file.read(length)).hexdigest()


def start_hash(path: Path, size: int) -> str:
    """Return the sha256 of the first bytes of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        # Not the whole file: its writer may have appended since.
        while size > 0 and (block := file.read(min(size, _BLOCK))):
            digest.update(block)
            size -= len(block)
    return digest.hexdigest()
