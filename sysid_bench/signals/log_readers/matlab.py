"""MATLAB files: variables, and fields of structs as "struct.field"; version 7.3 is HDF5."""

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_readers.hdf5 import read_matlab_73
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, table_of_arrays
from sysid_bench.types import Array

_HEADER: Final = 128
_COMPRESSED: Final = 15
"""Of MATLAB 5: bytes before the first element, and the type of a compressed one."""

_PART: Final = 2**16


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
    import scipy.io  # 0.1 s, spent only where such a file is read

    try:
        check_file(path, LARGEST_LOG)
        _check_size(path, scipy.io.whosmat)
        found = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
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


def _check_size(path: Path, headers: Callable[[Path], Any]) -> None:
    """Raise ValueError for more numbers than a log may have, as the headers of the file state."""
    try:
        size = sum(8 * math.prod(shape) for _, shape, _ in headers(path))
    except TypeError:  # objects of MATLAB have no shape; SciPy reads the other variables
        size = _unpacked_size(path)
    if size > LARGEST_LOG:
        raise ValueError(f"it unpacks to {size} bytes; {LARGEST_LOG} are allowed at most")


def _unpacked_size(path: Path) -> int:
    """Return the bytes of the elements of a MATLAB 5 file, no more than are too many."""
    size = 0
    with path.open("rb") as file:
        file.seek(_HEADER)
        while len(tag := file.read(8)) == 8 and size <= LARGEST_LOG:
            kind, count = struct.unpack("<II", tag)
            unpack = zlib.decompressobj().decompress if kind == _COMPRESSED else bytes
            while count > 0 and size <= LARGEST_LOG and (part := file.read(min(count, _PART))):
                count -= len(part)
                size += len(unpack(part))
    return size


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
