"""NumPy array files: npz by the names of its arrays, npy by the index of its columns."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from zipfile import BadZipFile

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.signals.log_table import LogTable, table_of_arrays


@dataclass(frozen=True)
class NumpyArrays:
    """Numeric arrays of one length; the others in the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".npz", ".npy")

    def read(self, path: Path) -> LogTable:
        """Return the arrays as columns; raises UsageError for a damaged file, or one with pickled
        objects."""
        try:
            with path.open("rb") as file:
                # Unpickling runs code of whoever wrote the file.
                found = np.load(file, allow_pickle=False)
                arrays = dict(found) if hasattr(found, "files") else {"": found}
        except (ValueError, EOFError, BadZipFile) as error:
            raise UsageError(
                f"{path} is not an array file that can be read safely: {error}."
            ) from error
        return table_of_arrays(path, arrays)
