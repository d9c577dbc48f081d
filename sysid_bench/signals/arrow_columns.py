"""Columns of Arrow tables as arrays of floats."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_table import LARGEST_LOG
from sysid_bench.types import Array


def read_arrow(path: Path, columns: Sequence[str] | None = None) -> Any:
    """Return the Arrow table in a parquet file, or some of its columns; raises UsageError for a
    damaged file, OSError for one that is not a file or too large."""
    import pyarrow.parquet  # 0.2 s, spent only where such a file is read

    try:
        check_file(path, LARGEST_LOG)
        file = pyarrow.parquet.ParquetFile(path)
        _check_size(file.metadata)
        return file.read(columns)
    except (pyarrow.ArrowException, ValueError) as error:
        raise UsageError(f"{path} is not a parquet file that can be read: {error}.") from error


def _check_size(metadata: Any) -> None:
    """Raise ValueError for more data than a log may have: repeated values take next to no place in
    the file."""
    groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    size = max(
        8 * metadata.num_rows * metadata.num_columns, sum(group.total_byte_size for group in groups)
    )
    if size > LARGEST_LOG:
        raise ValueError(f"it unpacks to {size} bytes; {LARGEST_LOG} are allowed at most")


def arrow_arrays(path: Path, table: Any) -> dict[str, Array]:
    """Return the numeric columns (N, k) of an Arrow table by name; raises UsageError without one,
    or for a name that two of them have."""
    found: dict[str, Array] = {}
    for name, array in _numeric_columns(table):
        if name in found:
            raise UsageError(f"{path}: two columns are named {name!r}; rename one.")
        found[name] = array
    if not found or table.num_rows == 0:
        raise UsageError(f"{path} holds no column of numbers.")
    return found


def _numeric_columns(table: Any) -> Iterator[tuple[str, Array]]:
    """Yield name and floats (N, k) of each column of numbers or lists of numbers, and of time
    stamps in s."""
    for name in table.column_names:
        array = _floats(table.column(name))
        if array is not None:
            yield name.strip(), array


def _floats(column: Any) -> Array | None:
    """Return a column as floats (N, k), None for one without numbers."""
    from pyarrow import int64, timestamp, types

    if types.is_timestamp(column.type):
        # Through whole nanoseconds, since a file may hold ms, us or ns.
        whole = column.cast(timestamp("ns")).cast(int64())
        return np.asarray(whole.to_numpy().astype(float) * 1e-9)[:, None]
    if types.is_floating(column.type) or types.is_integer(column.type):
        return np.asarray(column.to_numpy(), dtype=float)[:, None]
    if types.is_list(column.type) or types.is_fixed_size_list(column.type):
        return _list_floats(column)
    return None


def _list_floats(column: Any) -> Array | None:
    """Return lists of one length as floats (N, k), None for other lists."""
    from pyarrow import types

    inner = column.type.value_type
    if column.null_count or not (types.is_floating(inner) or types.is_integer(inner)):
        return None
    parts = [chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks]
    flat = np.concatenate([np.asarray(part, dtype=float) for part in parts] or [np.zeros(0)])
    k, rest = divmod(len(flat), max(len(column), 1))
    lengths = {len(value) for chunk in column.chunks for value in chunk} if k else set()
    return flat.reshape(-1, k) if k and not rest and lengths == {k} else None
