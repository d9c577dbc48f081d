"""Parquet tables, as pandas and polars write them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, column_names
from sysid_bench.types import Array


@dataclass(frozen=True)
class Parquet:
    """Columns of numbers and of time stamps (s); the others in the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".parquet",)

    def read(self, path: Path) -> LogTable:
        """Return the columns by name; raises UsageError where none holds numbers, or for a damaged
        file."""
        import pyarrow.parquet  # 0.2 s, spent only where such a file is read

        try:
            check_file(path, LARGEST_LOG)
            _check_size(pyarrow.parquet.read_metadata(path))
            table = pyarrow.parquet.read_table(path)
        except (pyarrow.ArrowException, ValueError) as error:
            raise UsageError(f"{path} is not a parquet file that can be read: {error}.") from error
        found = list(_numeric_columns(pyarrow, table))
        if not found or len(found[0][1]) == 0:
            raise UsageError(f"{path} holds no column of numbers.")
        names, parts = zip(*found, strict=True)
        return LogTable(path, np.stack(parts, axis=1), column_names(path, names))


def _check_size(metadata: Any) -> None:
    """Raise ValueError for more data than a log may have: repeated values take next to no place in
    the file."""
    groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
    size = max(
        8 * metadata.num_rows * metadata.num_columns, sum(group.total_byte_size for group in groups)
    )
    if size > LARGEST_LOG:
        raise ValueError(f"it unpacks to {size} bytes; {LARGEST_LOG} are allowed at most")


def _numeric_columns(arrow: Any, table: Any) -> Iterator[tuple[str, Array]]:
    """Yield name and floats of each column of numbers, and of time stamps in s."""
    for name in table.column_names:
        column = table.column(name)
        if arrow.types.is_timestamp(column.type):
            # Through whole nanoseconds, since a file may hold ms, us or ns.
            column = column.cast(arrow.timestamp("ns")).cast(arrow.int64())
            yield name.strip(), column.to_numpy().astype(float) * 1e-9
        elif arrow.types.is_floating(column.type) or arrow.types.is_integer(column.type):
            yield name.strip(), np.asarray(column.to_numpy(), dtype=float)
