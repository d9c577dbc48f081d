"""Writing of data frames as Parquet files, a group of rows at a time."""

import json
import secrets
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import pyarrow
from pyarrow import compute, parquet

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
                is_wider = column.type == pyarrow.int64() and wanted == pyarrow.float64()
                if not (column.type == wanted or pyarrow.types.is_null(column.type) or is_wider):
                    raise ValueError(f"{column.name!r} changes from {column.type} to {wanted}.")

    def read(self, cells: Sequence[str]) -> dict[str, pyarrow.Table]:
        """Return the lines of the next cells of each frame."""
        while self._left["cells"].num_rows < len(cells):
            for frame, file in self._files.items():
                group = file.read_row_group(self._next, use_threads=False)
                self._left[frame] = pyarrow.concat_tables([self._left[frame], group])
            self._next += 1
        wanted, found = pyarrow.array(cells, pyarrow.string()), {}
        for frame, left in self._left.items():
            is_of = compute.is_in(left["id"], wanted) if left.num_rows else None
            count = 0 if is_of is None else compute.sum(is_of).as_py()
            found[frame], self._left[frame] = left.slice(0, count), left.slice(count)
        return found


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
    schemas = {
        frame: pyarrow.schema(
            [(name, _arrow_type(found)) for name, found in columns.items()],
            metadata={"sysid_bench": number},
        )
        for frame, columns in kinds.items()
    }
    if stored is not None:
        stored.check(schemas)
    options = {"compression": "zstd", "write_page_checksum": True}
    with ExitStack() as stack:
        writers = {
            frame: stack.enter_context(parquet.ParquetWriter(files[frame], schema, **options))
            for frame, schema in schemas.items()
        }
        for cells, group in groups:
            old = [] if stored is None else [cell for cell in cells if cell in stored.cells]
            parts = stored.read(old) if stored is not None and old else {}
            for frame, columns in group.items():
                table = _table(columns, schemas[frame])
                if frame in parts:
                    table = _joined(parts[frame], table, cells)
                writers[frame].write_table(table, row_group_size=max(1, table.num_rows))


def _joined(old: pyarrow.Table, new: pyarrow.Table, cells: Sequence[str]) -> pyarrow.Table:
    """Lines of two tables with the types of the second, in the order of the cells."""
    columns = [
        old[field.name].cast(field.type, safe=False)
        if field.name in old.column_names
        else pyarrow.nulls(old.num_rows, field.type)
        for field in new.schema
    ]
    table = pyarrow.concat_tables([pyarrow.Table.from_arrays(columns, schema=new.schema), new])
    if not (old.num_rows and new.num_rows):
        return table
    place = {cell: number for number, cell in enumerate(cells)}
    return table.take(np.argsort([place[cell] for cell in table["id"].to_pylist()], kind="stable"))


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
        values = [v if v is None or isinstance(v, str) else json.dumps(v) for v in values]
    return pyarrow.array(values, kind, from_pandas=True)
