"""Parquet tables, as pandas and polars write them."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.signals.log_table import LogTable, column_names


@dataclass(frozen=True)
class Parquet:
    """Columns of numbers and of time stamps (s); the others in the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".parquet",)

    def read(self, path: Path) -> LogTable:
        """Return the columns by name; raises UsageError where none holds numbers, or for a damaged
        file."""
        import pyarrow  # 0.2 s, spent only where such a file is read
        import pyarrow.parquet

        try:
            table = pyarrow.parquet.read_table(path)
        except (pyarrow.ArrowException, ValueError) as error:
            raise UsageError(f"{path} is not a parquet file that can be read: {error}.") from error
        parts, names = [], []
        for name in table.column_names:
            kind = table.schema.field(name).type
            if pyarrow.types.is_timestamp(kind):
                column = table.column(name).cast(pyarrow.timestamp("ns")).cast(pyarrow.int64())
                parts.append(column.to_numpy().astype(float) * 1e-9)
            elif pyarrow.types.is_floating(kind) or pyarrow.types.is_integer(kind):
                parts.append(np.asarray(table.column(name).to_numpy(), dtype=float))
            else:
                continue
            names.append(name.strip())
        if not parts or len(parts[0]) == 0:
            raise UsageError(f"{path} holds no column of numbers.")
        return LogTable(path, np.stack(parts, axis=1), column_names(path, names))
