"""Data frames of rows, and the Parquet files of a run that hold them.

A row makes a part of each frame: one line of `cells`, and one of `parameters` and `joints` for each
entry of its tables. Frames are Arrow tables: in memory for few rows (`data_frames`), else in the
files cells.parquet, parameters.parquet and joints.parquet (`build_frames`). These are written in
bounded memory: rows are copied to a temporary file first, for the types of all columns and the last
row of each cell; then they are written in the order of the plan, in groups.

consolidated.json states up to which byte of each row file the three files hold the rows, and the
hashes of their footers, and counts these rows. Readers use them where all of that is true and the
file is as it was written; else the row files decide.
"""

import hashlib
import json
import marshal
import os
import secrets
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import chain, islice
from pathlib import Path
from types import NoneType
from typing import IO, TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from sysid_bench.canonical_json import canonical
from sysid_bench.harness.work.row_files import (
    TABLES,
    columns_of,
    lines,
    parse_row,
    row_files,
    with_entries,
)
from sysid_bench.input_files import LARGEST_HASHED, check_file, file_hash, parse_json, read_text
from sysid_bench.metrics import METRICS, names_of
from sysid_bench.types import Row
from sysid_bench.words import COVERAGE, JOINT, LABELS, PARAMETER, STD_FROM, VERDICT

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow

FRAMES: Final = ("cells", "parameters", "joints")
_TABLE_OF: Final = {"parameters": "parameters_table", "joints": "joints"}
"""Field of a row by the frame that its entries make."""
_FIRST: Final[Mapping[str, tuple[str, ...]]] = {
    "cells": ("id", "experiment", *LABELS, "repeat", "status", "reason"),
    "parameters": (
        *("id", "body", "name", "true", "estimate", "std", "std_from", "identifiable"),
        *("base_error", "bound", "bound_encoders"),
    ),
    "joints": ("id", "name"),
}
"""Columns that a frame has in any case."""
_JOINT_COLUMNS: Final = {"name": JOINT, **{METRICS[name].key: name for name in names_of("joint")}}

COVERAGE_FILE: Final = "consolidated.json"
UNREADABLE: Final = (
    *(OSError, ValueError, LookupError, TypeError, NotImplementedError),
    ImportError,  # without the extra `parquet` the row files decide
)
"""Errors of reading a Parquet file that is absent or damaged."""
HEAD: Final = ("id", "status", "reason", "crosscheck", "fingerprint", "losses", "sources")
"""Fields of a row on which the next run, its result and the status of a run depend."""

_GROUP: Final = 1000  # cells whose values are in memory at a time
_FORMAT: Final = 3
_HASH: Final = "sha256"
"""First key of consolidated.json: hash of the text behind it."""
_BLOCK: Final = 1 << 20
_MOST_KINDS: Final = 10_000
"""Kinds of rows that are counted in consolidated.json: reasons may differ in every row."""
_HUGE: Final = 2**63
_LETTERS: Final = {kind.__name__[0]: kind for kind in (bool, int, float, str, NoneType)}

ReadFrame = Callable[[str, Collection[str] | None], "pd.DataFrame"]
"""(frame, fields or None for all) -> the frame with the columns of those fields that it has."""
_Columns = dict[str, list[Any]]
"""Values of the columns of a frame."""
_Types = tuple[tuple[str, frozenset[type]], ...]
"""Types of the values of each column of a part of a frame."""
_Kind = tuple[_Types, ...]
"""Types of the parts that a row makes of the frames."""


@dataclass(frozen=True, eq=False)
class Frames:
    """`cells` has a line per row; `parameters` and `joints` have one per parameter or joint of the
    cell `id`. Each is read when it is used first. `fields`: the fields of `cells`, and of what is
    made of them, where these are not all: lines by joint repeat those of their cell."""

    read: ReadFrame
    fields: frozenset[str] | None = None

    @cached_property
    def cells(self) -> "pd.DataFrame":
        """One line per row."""
        always = {"id", "status", "estimator", COVERAGE}
        return self.read("cells", None if self.fields is None else self.fields | always)

    @cached_property
    def parameters(self) -> "pd.DataFrame":
        """One line per cell and parameter."""
        return self.read("parameters", None)

    @cached_property
    def joints(self) -> "pd.DataFrame":
        """One line per cell and joint."""
        return self.read("joints", None)

    @cached_property
    def by_parameter(self) -> "pd.DataFrame":
        """`cells` with a line per parameter (m, ..., fc) and its verdict; a cell without any has a
        line for each parameter of the others."""
        names = {"name": PARAMETER, "identifiable": VERDICT}
        verdicts = self.read("parameters", ["id", *names]).rename(columns=names)
        return self._merged(verdicts, PARAMETER)

    @cached_property
    def by_value(self) -> "pd.DataFrame":
        """`cells` with a line for each parameter (body.name), its estimate and verdict."""
        columns = ["id", "body", "name", "estimate", "identifiable"]
        values = self.read("parameters", columns)
        names = (values["body"].astype(str) + "." + values["name"].astype(str)).rename(PARAMETER)
        values = values.rename(columns={"identifiable": VERDICT}).drop(columns=["body", "name"])
        found: pd.DataFrame = self.cells.merge(values.assign(**{PARAMETER: names}), on="id")
        return found

    @cached_property
    def by_joint(self) -> "pd.DataFrame":
        """`cells` with a line per joint and its errors; a cell without any has a line for each
        joint of the others."""
        names = {
            key: name
            for key, name in _JOINT_COLUMNS.items()
            if self.fields is None or name in self.fields | {JOINT}
        }
        errors = self.read("joints", ["id", *names]).rename(columns=names)
        return self._merged(errors.reindex(columns=["id", *names.values()]), JOINT)

    def _merged(self, entries: "pd.DataFrame", label: str) -> "pd.DataFrame":
        """`cells` with a line for each line of `entries` (id, label, ...), in order."""
        import pandas as pd

        cells = self.cells.reset_index(names="order")
        without = cells[~cells["id"].isin(entries["id"])]
        values = pd.DataFrame({label: entries[label].unique() if len(entries) else [None]})
        parts = [cells.merge(entries, on="id"), without.merge(values, how="cross")]
        # Empty frames would decide on the types of the columns, too.
        lines = pd.concat([part for part in parts if len(part)] or parts)
        return lines.sort_values("order", kind="stable", ignore_index=True).drop(columns="order")

    @cached_property
    def by_std_from(self) -> "pd.DataFrame":
        """`cells` with a line per source of standard deviations, and its coverage. A cell that is
        not ok has a line for each source of its estimator in other cells, else for all sources;
        without any source (exact data) each cell has one line."""
        import pandas as pd

        # A metric of intervals has a column for each kind of interval: "coverage.KIND".
        figures = names_of("interval")
        columns = list(map(str, self.cells.columns))
        kinds = [name for name in columns if name.startswith(f"{COVERAGE}.")]
        prefixes = tuple(f"{name}." for name in figures)
        plain = self.cells.drop(columns=[name for name in columns if name.startswith(prefixes)])
        if not kinds:
            plain[STD_FROM], plain[COVERAGE] = "none", None
            return plain
        failed, estimator = self.cells["status"] != "ok", self.cells["estimator"]
        unknown = ~estimator.isin(estimator[self.cells[kinds].notna().any(axis=1)])
        lines = []
        for kind in kinds:
            coverage = self.cells[kind]
            alike = estimator.isin(estimator[coverage.notna()])
            line = plain[coverage.notna() | failed & (unknown | alike)].copy()
            line[STD_FROM] = kind.removeprefix(f"{COVERAGE}.")
            for name in figures:
                line[name] = self.cells.get(kind.replace(COVERAGE, name, 1))
            lines.append(line)
        return pd.concat(lines).sort_index(kind="stable", ignore_index=True)


def data_frames(rows: Iterable[Row]) -> Frames:
    """Return the frames of rows; nested tables of a cell become columns with dotted names."""
    parts = list(map(_parts_of, rows))
    types = _column_types({_kind_of(part): None for part in parts})
    tables = {frame: _values([part[frame] for part in parts], types[frame]) for frame in FRAMES}

    def read(name: str, fields: Collection[str] | None) -> "pd.DataFrame":
        table, kinds = tables[name], types[name]
        wanted = _columns_of_fields(fields, table)
        # Without Arrow, and with the same types as from a Parquet file (`_pandas_frame`).
        size = len(next(iter(table.values()), ()))
        return _frame({key: _array(table[key], kinds[key]) for key in wanted}, size)

    return Frames(read)


def _array(values: list[Any], kind: str) -> np.ndarray:
    """Values of a column as `_pandas_frame` gives them: NaN is absent, as None is."""
    if kind in ("double", "int64"):
        floats = [np.nan if v is None else v for v in values]
        return np.array(floats, dtype=float if kind == "double" else np.int64)
    made = np.empty(len(values), dtype=object)
    made[:] = [None if isinstance(v, float) and v != v else v for v in values]
    return made


# --- From rows to Arrow tables ------------------------------------------------------------------


def _parts_of(row: Row) -> dict[str, _Columns]:
    """Part of each frame that a row makes, empty where it has no entries."""
    cell = _flat({key: value for key, value in row.items() if key not in TABLES})
    parts: dict[str, _Columns] = {"cells": {key: [value] for key, value in cell.items()}}
    for frame, field in _TABLE_OF.items():
        columns = columns_of(row.get(field))
        if columns is None or any({dict, list} & set(map(type, c)) for c in columns.values()):
            written = with_entries(row).get(field) or ()
            entries = [{"id": row["id"], **_flat(entry)} for entry in written]
            names = dict.fromkeys(chain.from_iterable(entries))
            parts[frame] = {name: [entry.get(name) for entry in entries] for name in names}
        else:
            # Most tables are written by column, and need not be taken apart.
            size = len(next(iter(columns.values())))
            parts[frame] = {"id": [row["id"]] * size, **columns} if size else {}
    return parts


def _flat(row: Mapping[str, Any], prefix: str = "") -> Row:
    """Return a row without nesting: names with dots for mappings, JSON texts for lists."""
    fields: Row = {}
    for key, value in row.items():
        if isinstance(value, dict):
            fields |= _flat(value, f"{prefix}{key}.")
        else:
            # Lists are stored as JSON, which DuckDB and people both read.
            fields[prefix + key] = json.dumps(value) if isinstance(value, list) else value
    return fields


def _kind_of(parts: Mapping[str, _Columns]) -> _Kind:
    """Types of the columns. A whole number beyond 64 bits counts as a text, too: no column of
    numbers holds all of its digits."""
    kind = []
    for frame in FRAMES:
        columns = []
        for name, values in parts[frame].items():
            types = set(map(type, values))
            if int in types and any(type(v) is int and abs(v) >= _HUGE for v in values):
                types.add(str)
            columns.append((name, frozenset(types)))
        kind.append(tuple(columns))
    return tuple(kind)


def _schemas(kinds: Collection[_Kind]) -> dict[str, "pyarrow.Schema"]:
    """Schema of each frame, with the columns in the order in which rows name them."""
    import pyarrow

    number = {"sysid_bench": secrets.token_hex(8)}  # files with equal footers are of one writing
    columns = _column_types(kinds)
    return {frame: pyarrow.schema([*columns[frame].items()], metadata=number) for frame in FRAMES}


def _column_types(kinds: Collection[_Kind]) -> dict[str, dict[str, str]]:
    """Arrow's name of the type of each column of each frame, in the order in which rows name
    them."""
    columns, absent = {}, frozenset({NoneType})
    for place, frame in enumerate(FRAMES):
        parts = [dict(kind[place]) for kind in kinds if kind[place]]
        names = dict.fromkeys((*_FIRST[frame], *chain.from_iterable(parts)))
        types = {name: {t for part in parts for t in part.get(name, absent)} for name in names}
        columns[frame] = {name: _arrow_type(found) for name, found in types.items()}
    return columns


def _arrow_type(types: Collection[type]) -> str:
    """One type for a column: Parquet does not mix texts and numbers, and pandas has no whole
    numbers beside absent ones."""
    given = {*types} - {NoneType}
    if not given:
        return "null"
    if given <= {int, float}:
        return "int64" if types == {int} else "double"
    return "bool" if given == {bool} else "string"


def _table(parts: Iterable[_Columns], schema: "pyarrow.Schema") -> "pyarrow.Table":
    """Lines of the parts of a frame as an Arrow table."""
    import pyarrow

    columns = _values(parts, {field.name: str(field.type) for field in schema})
    # from_pandas: NaN is absent, as None is.
    arrays = [pyarrow.array(v, schema.field(n).type, from_pandas=True) for n, v in columns.items()]
    return pyarrow.Table.from_arrays(arrays, schema=schema)


def _values(parts: Iterable[_Columns], types: Mapping[str, str]) -> _Columns:
    """Values of the columns of a frame; what a part lacks is absent."""
    columns: _Columns = {name: [] for name in types}
    for part in parts:
        size = max(map(len, part.values()), default=0)
        for name, values in columns.items():
            values += part.get(name) or [None] * size
    for name, values in columns.items():
        kind, found = types[name], set(map(type, values))
        if kind == "double" and int in found:
            columns[name] = [None if v is None else float(v) for v in values]
        elif kind == "string" and not found <= {str, NoneType}:
            columns[name] = [
                v if v is None or isinstance(v, str) else json.dumps(v) for v in values
            ]
    return columns


# --- From Arrow tables to data frames and rows --------------------------------------------------


def _columns_of_fields(fields: Collection[str] | None, known: Iterable[str]) -> list[str]:
    """Return the known columns that fields have, nested ones several (`_flat`); all for None."""
    if fields is None:
        return list(known)
    return [name for name in known if name in fields or name.partition(".")[0] in fields]


def _pandas_frame(table: "pyarrow.Table") -> "pd.DataFrame":
    """Columns of numbers, else of objects with None for what is absent."""
    made = {}
    for name in table.column_names:
        column = table.column(name)
        if column.type in ("double", "int64"):
            values = column.to_numpy()
        elif column.type != "string":
            values = np.array(column.to_pylist(), dtype=object)
        else:
            # Each text is made once; a column of codes refers to it.
            chunks = column.dictionary_encode().unify_dictionaries().chunks
            texts = [*(chunks[0].dictionary.to_pylist() if chunks else ()), None]
            codes = [chunk.indices.fill_null(len(texts) - 1).to_numpy() for chunk in chunks]
            words = np.array(texts, dtype=object)
            values = words[np.concatenate(codes)] if codes else np.array([], dtype=object)
        made[name] = values
    return _frame(made, table.num_rows)


def _frame(columns: Mapping[str, np.ndarray], size: int) -> "pd.DataFrame":
    import pandas as pd

    # With its type, since pandas 3 makes texts a type of its own, whose absent value is NaN.
    made = {name: pd.Series(values, dtype=values.dtype) for name, values in columns.items()}
    return pd.DataFrame(made, index=pd.RangeIndex(size))


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
            if _footer_hash(path) != coverage.footers.get(name):
                raise ValueError(f"{path} is not of this consolidation.")
        self._next_group = 0
        self._left = {name: file.schema_arrow.empty_table() for name, file in self._files.items()}

    @cached_property
    def ids(self) -> frozenset[str]:
        """Cells of which the files hold the row."""
        return frozenset(self._table("cells", ["id"])["id"].to_pylist())

    def read(self, name: str, fields: Collection[str] | None = None) -> "pd.DataFrame":
        """Return a frame, or the columns of some fields that are there, as rows give it."""
        return _pandas_frame(self._table(name, fields))

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
        columns = _columns_of_fields(fields, file.schema_arrow.names)
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


# --- What the files hold ------------------------------------------------------------------------


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
            return state.st_size >= self.bytes and _start_hash(path, self.bytes) == self.sha256
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


def _footer_hash(path: Path) -> str:
    """Return the sha256 of the footer of a Parquet file, with its length and the magic number."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 8, 0))
        length = int.from_bytes(file.read(4), "little") + 8
        file.seek(max(size - length, 0))
        return hashlib.sha256(file.read(length)).hexdigest()


def _start_hash(path: Path, size: int) -> str:
    """Return the sha256 of the first bytes of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        # Not the whole file: its writer may have appended since.
        while size > 0 and (block := file.read(min(size, _BLOCK))):
            digest.update(block)
            size -= len(block)
    return digest.hexdigest()


# --- Consolidation ------------------------------------------------------------------------------


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
            footers = {name: _footer_hash(part) for name, part in parts.items()}
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
        self._kinds: dict[_Kind, int] = {}
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
            covered[path.name] = CoveragePart(end, count, _start_hash(path, end), changed)
        return covered

    def _take_row(self, row: Row) -> None:
        """Copy a row of a planned cell."""
        cell = row["id"]
        if cell in self._stored:
            raise _ReplacedRowError(cell)
        if cell in self._planned.fields:
            counted = RowKind.of(row, self._planned.places[cell])
            self._counted[cell] = self._row_kinds.setdefault(counted, counted)
            parts = _parts_of(row | self._planned.fields[cell])
            # The types of all rows are needed before the first line of a Parquet file.
            number = self._kinds.setdefault(_kind_of(parts), len(self._kinds))
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
    def kinds(self) -> dict[_Kind, str]:
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
        first: dict[_Kind, str] = {}
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

    def groups(self) -> Iterator[tuple[list[str], list[dict[str, _Columns]]]]:
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

    schemas = _schemas(scan.kinds)
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
                table = _table([parts[frame] for parts in group], schema)
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
