"""Writing of data frames as Parquet files, a group of rows at a time."""

import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import pyarrow
from pyarrow import compute, parquet

from sysid_bench.harness.data_frames import json_text

Columns = Mapping[str, list[Any]]
"""Name -> values of a group of rows."""


Group = tuple[Sequence[str], Mapping[str, Columns]]
"""Cells in the order of the plan, and the columns of those that are not stored yet, by frame."""


class StoredFrames:
    """Parquet files of an earlier consolidation, read once from begin to end."""

    def __init__(self, files: Mapping[str, parquet.ParquetFile]) -> None:
        self._files = files
        self._next = 0
        self._left = {frame: file.schema_arrow.empty_table() for frame, file in files.items()}
        self.cells = frozenset(files["cells"].read(columns=["id"])["id"].to_pylist())

    def check(self, schemas: Mapping[str, pyarrow.Schema]) -> None:
        """Raise ValueError where the values would be others in columns of these types."""
        for frame, file in self._files.items():
            for column in file.schema_arrow:
                wanted = schemas[frame].field(column.name).type
                if not _holds(wanted, column.type):
                    raise ValueError(f"{column.name!r} changes from {column.type} to {wanted}.")

    def read(self, cells: Sequence[str]) -> dict[str, pyarrow.Table]:
        """Return the lines of each frame of those of the next cells that are stored; nothing where
        none is."""
        stored = [cell for cell in cells if cell in self.cells]
        while self._left["cells"].num_rows < len(stored):
            self._read_group()
        wanted = pyarrow.array(stored, pyarrow.string())
        return {frame: self._take(frame, wanted) for frame in self._files} if stored else {}

    def _read_group(self) -> None:
        for frame, file in self._files.items():
            group = file.read_row_group(self._next, use_threads=False)
            self._left[frame] = pyarrow.concat_tables([self._left[frame], group])
        self._next += 1

    def _take(self, frame: str, wanted: pyarrow.Array) -> pyarrow.Table:
        """Remove the lines of the wanted cells, which are the next, and return them."""
        left = self._left[frame]
        count = compute.sum(compute.is_in(left["id"], wanted)).as_py() if left.num_rows else 0
        self._left[frame] = left.slice(count)
        return left.slice(0, count)


def _holds(wanted: pyarrow.DataType, found: pyarrow.DataType) -> bool:
    """True where a column of the wanted type holds the values of the other as they are."""
    is_wider = found == pyarrow.int64() and wanted == pyarrow.float64()
    return bool(found == wanted or pyarrow.types.is_null(found) or is_wider)


def write_frames(
    files: Mapping[str, Path],
    kinds: Mapping[str, Mapping[str, frozenset[type]]],
    groups: Iterable[Group],
    stored: StoredFrames | None = None,
) -> None:
    """Write the frames of `groups`, and of the `stored` cells among them, to their files.

    `kinds` gives the types that occur in each column of each frame. Raises ValueError where the
    stored columns do not fit them.
    """
    number = secrets.token_hex(8)  # files with equal footers are of one consolidation
    schemas = {frame: _schema(columns, number) for frame, columns in kinds.items()}
    if stored is not None:
        stored.check(schemas)
    options = {"compression": "zstd", "write_page_checksum": True}
    with ExitStack() as stack:
        writers = {
            frame: stack.enter_context(parquet.ParquetWriter(files[frame], schema, **options))
            for frame, schema in schemas.items()
        }
        for tables in _tables(groups, schemas, stored):
            for frame, table in tables.items():
                writers[frame].write_table(table, row_group_size=max(1, table.num_rows))


def _schema(columns: Mapping[str, frozenset[type]], number: str) -> pyarrow.Schema:
    types = [(name, _arrow_type(found)) for name, found in columns.items()]
    return pyarrow.schema(types, metadata={"sysid_bench": number})


def _tables(
    groups: Iterable[Group],
    schemas: Mapping[str, pyarrow.Schema],
    stored: StoredFrames | None,
) -> Iterator[dict[str, pyarrow.Table]]:
    """Yield the lines of each frame for a group of cells, new and stored ones."""
    for cells, group in groups:
        tables = {frame: _table(columns, schemas[frame]) for frame, columns in group.items()}
        parts = {} if stored is None else stored.read(cells)
        yield tables | {frame: _joined(old, tables[frame], cells) for frame, old in parts.items()}


def _joined(old: pyarrow.Table, new: pyarrow.Table, cells: Sequence[str]) -> pyarrow.Table:
    """Lines of two tables with the types of the second, in the order of the cells."""
    columns = [_typed_column(old, field) for field in new.schema]
    table = pyarrow.concat_tables([pyarrow.Table.from_arrays(columns, schema=new.schema), new])
    if not (old.num_rows and new.num_rows):
        return table
    place = {cell: number for number, cell in enumerate(cells)}
    return table.take(np.argsort([place[cell] for cell in table["id"].to_pylist()], kind="stable"))


def _typed_column(table: pyarrow.Table, field: pyarrow.Field) -> pyarrow.Array:
    """Column of a table with the type of a field, without values where the table lacks it."""
    if field.name not in table.column_names:
        return pyarrow.nulls(table.num_rows, field.type)
    return table[field.name].cast(field.type, safe=False)


def _arrow_type(kinds: frozenset[type]) -> pyarrow.DataType:
    """Type of a column, by the rules of `data_frames`."""
    given = kinds - {NoneType}
    if not given:
        return pyarrow.null()
    if given <= {int, float}:
        return pyarrow.int64() if kinds == {int} else pyarrow.float64()
    return pyarrow.bool_() if given == {bool} else pyarrow.string()


def _table(columns: Columns, schema: pyarrow.Schema) -> pyarrow.Table:
    arrays = [_array(columns[name], schema.field(name).type) for name in schema.names]
    return pyarrow.Table.from_arrays(arrays, schema=schema)


def _array(values: list[Any], kind: pyarrow.DataType) -> pyarrow.Array:
    kinds = set(map(type, values))
    if kind == pyarrow.float64() and int in kinds:
        values = [None if v is None else float(v) for v in values]
    elif kind == pyarrow.string() and not kinds <= {str, NoneType}:
        values = list(map(json_text, values))
    return pyarrow.array(values, kind, from_pandas=True)
