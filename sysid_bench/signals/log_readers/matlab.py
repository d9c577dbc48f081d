"""MATLAB files: variables, and fields of structs as "struct.field"; version 7.3 is HDF5."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_readers.hdf5 import read_matlab_73
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, table_of_arrays
from sysid_bench.types import Array


@dataclass(frozen=True)
class Matlab:
    """Numeric variables of one length; the others in the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".mat",)

    def read(self, path: Path) -> LogTable:
        """Return the variables as columns; raises UsageError for a damaged file."""
        found = _load(path)
        return read_matlab_73(path) if found is None else table_of_arrays(path, found)


def _load(path: Path) -> dict[str, Array] | None:
    """Return the numeric arrays by name, None for a file of version 7.3."""
    from scipy.io import loadmat, whosmat  # 0.1 s, spent only where such a file is read

    try:
        check_file(path, LARGEST_LOG)
        _check_size(whosmat(path))
        found = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        return None
    except MemoryError as error:
        raise UsageError(
            f"{path} states more data than memory holds: it is damaged or too large; save it again."
        ) from error
    except Exception as error:  # SciPy's parser raises many types on damaged files
        raise UsageError(
            f"{path} is not a MATLAB file that can be read: {reason_of(error)}."
        ) from error
    return dict(_variables(found))


def _check_size(variables: Iterable[tuple[str, tuple[int, ...], str]]) -> None:
    """Raise ValueError for more numbers than a log may have, as the headers of the file state."""
    size = sum(8 * math.prod(shape) for _, shape, _ in variables)
    if size > LARGEST_LOG:
        raise ValueError(f"it unpacks to {size} bytes; {LARGEST_LOG} are allowed at most")


def _variables(found: dict[str, Any]) -> Iterator[tuple[str, Array]]:
    """Yield the numeric arrays of a file, without the entries that SciPy adds."""
    for name, value in found.items():
        if not name.startswith("__"):
            yield from _arrays(name, value)


def _arrays(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    """Yield the numeric arrays of a variable, recursing into structs."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield name, value
    for field in getattr(value, "_fieldnames", ()):
        yield from _arrays(f"{name}.{field}", getattr(value, field))
