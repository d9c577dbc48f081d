"""Parquet tables, as pandas and polars write them."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sysid_bench.signals.log_table import LogTable, columns_with_names


@dataclass(frozen=True)
class Parquet:
    """Columns of numbers, of lists of numbers of one length, and of time stamps (s); the others in
    the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".parquet",)

    def read(self, path: Path) -> LogTable:
        """Return the columns by name; raises UsageError where none holds numbers, or for a damaged
        file."""
        from sysid_bench.signals.arrow_columns import read_arrow  # loads pyarrow

        arrays = read_arrow(path)
        values, names = columns_with_names(path, {name: (x, ()) for name, x in arrays.items()})
        return LogTable(path, values, names)
