"""Columns of Arrow tables as arrays of floats."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet
from pyarrow import types

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_table import LARGEST_LOG
from sysid_bench.signals.read_progress import report
from sysid_bench.types import Array

_BATCH: Final = 65_536
"""Rows that are unpacked at once."""


def read_arrow(path: Path, columns: Sequence[str] | None = None) -> dict[str, Array]:
    """Return the numeric columns (N, k) of a parquet file, or some of them, by name, as parts of
    one array.

    Raises UsageError for a damaged file or one without numbers, OSError for one that is not a file
    or too large.
    """
    try:
        check_file(path, LARGEST_LOG)
        file = pyarrow.parquet.ParquetFile(path)
        _check_size(file.metadata)
        return _filled(path, _batches(file, columns), file.metadata.num_rows)
    except (pyarrow.ArrowException, ValueError) as error:
        raise UsageError(f"{path} is not a parquet file that can be read: {error}.") from error


def _filled(path: Path, batches: Iterator[Any], N: int) -> dict[str, Array]:
    """Return the columns of all batches; a column that is not numeric in one is left out."""
    found: dict[str, Array] = {}
    done = 0
    for batch in batches:
        arrays = _arrays(path, batch)
        if not done:
            found = _empty(arrays, N)
        found = {name: x for name, x in found.items() if _has_width(arrays.get(name), x)}
        for name, x in found.items():
            x[done : done + len(batch)] = arrays[name]
        done += len(batch)
        report(path, done, N)
    if not found or done != N:
        raise UsageError(f"{path} holds no column of numbers.")
    return found


def _batches(file: Any, columns: Sequence[str] | None) -> Iterator[Any]:
    """Yield the rows in parts; what Arrow has unpacked of a group of rows is given back."""
    for group in range(file.num_row_groups):
        yield from file.iter_batches(_BATCH, [group], columns, use_threads=False)
        pyarrow.default_memory_pool().release_unused()


def _split(whole: Array, widths: Sequence[int]) -> list[Array]:
    return np.split(whole, np.cumsum(widths)[:-1], axis=1)


def _check_size(metadata: Any) -> None:
    """Raise ValueError for more data than a log may have: repeated values take next to no place in
    the file."""
    groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    size = max(
        8 * metadata.num_rows * metadata.num_columns, sum(group.total_byte_size for group in groups)
    )
    if size > LARGEST_LOG:
        raise ValueError(f"it unpacks to {size} bytes; {LARGEST_LOG} are allowed at most")


def _arrays(path: Path, batch: Any) -> dict[str, Array]:
    """Return the numeric columns of a batch; raises UsageError for a name that two have."""
    found: dict[str, Array] = {}
    for name, array in _numeric_columns(batch):
        if name in found:
            raise UsageError(f"{path}: two columns are named {name!r}; rename one.")
        found[name] = array
    return found


def _numeric_columns(table: Any) -> Iterator[tuple[str, Array]]:
    """Yield name and floats (N, k) of each column of numbers or lists of numbers, and of time
    stamps in s."""
    for name, column in zip(table.schema.names, table.columns, strict=True):
        array = _floats(column)
        if array is not None:
            yield name.strip(), array


def _is_number(kind: Any) -> bool:
    return bool(types.is_floating(kind) or types.is_integer(kind))


def _floats(column: Any) -> Array | None:
    """Return a column as floats (N, k), None for one without numbers."""
    if types.is_timestamp(column.type):
        # Through whole nanoseconds, since a file may hold ms, us or ns.
        whole = column.cast(pyarrow.timestamp("ns")).cast(pyarrow.int64())
        return np.asarray(whole.to_numpy(zero_copy_only=False).astype(float) * 1e-9)[:, None]
    if _is_number(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)[:, None]
    if types.is_list(column.type) or types.is_fixed_size_list(column.type):
        return _list_floats(column)
    return None


def _empty(arrays: dict[str, Array], N: int) -> dict[str, Array]:
    """Return room for N rows of columns like these, as parts of one array."""
    widths = [x.shape[1] for x in arrays.values()]
    return dict(zip(arrays, _split(np.empty((N, sum(widths))), widths), strict=True))


def _has_width(part: Array | None, whole: Array) -> bool:
    return part is not None and part.shape[1] == whole.shape[1]


def _list_floats(column: Any) -> Array | None:
    """Return lists of one length as floats (N, k), None for other lists."""
    if column.null_count or not _is_number(column.type.value_type):
        return None
    flat = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=float)
    k, rest = divmod(len(flat), max(len(column), 1))
    same = k > 0 and all(len(value) == k for value in column)
    return flat.reshape(-1, k) if same and not rest else None
