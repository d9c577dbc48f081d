"""NumPy array files: npz by the names of its arrays, npy by the index of its columns."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.lib import format as npy

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.input_files import check_file
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, table_of_arrays


@dataclass(frozen=True)
class NumpyArrays:
    """Numeric arrays of one length; the others in the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".npz", ".npy")

    def read(self, path: Path) -> LogTable:
        """Return the arrays as columns; raises UsageError for a damaged file, one with pickled
        objects, and one with more numbers than LARGEST_LOG."""
        try:
            check_file(path, LARGEST_LOG)
            with path.open("rb") as file, _opened(file) as arrays:
                return table_of_arrays(path, arrays)
        except (OSError, UsageError):
            raise
        except Exception as error:  # NumPy and zipfile raise many types on damaged files
            raise UsageError(
                f"{path} is not an array file that can be read safely: {reason_of(error)}."
            ) from error


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a file by their names; raises OSError, ValueError or what NumPy raises
    for a file with pickled objects, with more numbers than LARGEST_LOG, or another one."""
    check_file(path, LARGEST_LOG)
    with path.open("rb") as file, _opened(file) as arrays:
        return {name: np.asarray(array) for name, array in arrays.items()}


class _Member:
    """Array of an archive, unpacked when NumPy asks for it."""

    def __init__(self, found: Any, name: str, shape: tuple[int, ...], dtype: Any) -> None:
        self.shape, self.dtype = shape, dtype
        self.ndim, self.size = len(shape), math.prod(shape)
        self._found, self._name = found, name

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.asarray(self._found[self._name], dtype=dtype)


@contextmanager
def _opened(file: IO[bytes]) -> Iterator[dict[str, Any]]:
    """Yield the arrays of a file by their names; raises ValueError for pickled ones."""
    # Unpickling runs code of whoever wrote the file.
    if file.read(2) != b"PK":
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        _check_array(file, size)
        file.seek(0)
        yield {"": np.load(file, allow_pickle=False)}
        return
    file.seek(0)
    with np.load(file, allow_pickle=False) as found:
        headers = _checked_headers(found.zip)
        yield {name: _member(found, name, headers.get(name)) for name in found.files}


def _member(found: Any, name: str, header: tuple[tuple[int, ...], Any] | None) -> Any:
    """Return an array of an archive, by its header where that says what it is."""
    return found[name] if header is None else _Member(found, name, *header)


def _checked_headers(archive: Any) -> dict[str, tuple[tuple[int, ...], Any] | None]:
    """Return shape and type of each array, None where NumPy has to say what it is.

    Raises ValueError where the directory, or the header of an array, states too much data.
    """
    members = archive.infolist()
    total = sum(member.file_size for member in members)
    if total > LARGEST_LOG:
        raise ValueError(_size_text(total))
    headers = {}
    for member in members:
        with archive.open(member) as part:
            name = member.filename.removesuffix(".npy")
            headers[name] = _check_array(part, member.file_size)
    return headers


def _check_array(part: IO[bytes], most: int) -> tuple[tuple[int, ...], Any] | None:
    """Return shape and type in the header of an array, None for something else.

    Raises ValueError where it states more bytes than there can be: NumPy would reserve them before
    reading.
    """
    if part.read(6) != npy.MAGIC_PREFIX:
        return None  # left to NumPy, which skips it or refuses it
    version = tuple(part.read(2))
    read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in read_header:  # 3.0 is for records with names in other scripts
        raise ValueError(f"arrays of the format {version} are not numbers of a log")
    shape, _, dtype = read_header[version](part)
    size = math.prod(shape) * dtype.itemsize
    if size > most or min(shape, default=0) < 0:
        raise ValueError(_size_text(size))
    return None if dtype.hasobject else (shape, dtype)


def _size_text(size: int) -> str:
    return (
        f"its headers state {size} bytes, more than there are or than the {LARGEST_LOG} that a "
        "log may have; write it again, or in parts"
    )
