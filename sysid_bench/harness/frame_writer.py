"""Writing of data frames as Parquet files, a group of rows at a time."""

import json
import secrets
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import NoneType
from typing import Any

import pyarrow
from pyarrow import parquet

Columns = Mapping[str, list[Any]]
"""Name -> values of a group of rows."""


def write_frames(
    files: Mapping[str, Path],
    kinds: Mapping[str, Mapping[str, frozenset[type]]],
    groups: Iterable[Mapping[str, Columns]],
) -> None:
    """Write the frames of `groups` (frame -> columns) to their files.

    `kinds` gives the types that occur in each column of each frame.
    """
    number = secrets.token_hex(8)  # files with equal footers are of one consolidation
    schemas = {
        frame: pyarrow.schema(
            [(name, _arrow_type(found)) for name, found in columns.items()],
            metadata={"sysid_bench": number},
        )
        for frame, columns in kinds.items()
    }
    options = {"compression": "zstd", "write_page_checksum": True}
    with ExitStack() as stack:
        writers = {
            frame: stack.enter_context(parquet.ParquetWriter(files[frame], schema, **options))
            for frame, schema in schemas.items()
        }
        for group in groups:
            for frame, columns in group.items():
                writers[frame].write_table(_table(columns, schemas[frame]))


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
