"""Files of arrays by name: NumPy, MATLAB and HDF5."""

import math
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, ClassVar, Final

import numpy as np
from numpy.lib import format as npy

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file, parse_json
from sysid_bench.signals.log_library import library_errors, log_library
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, check_size, table_of_arrays
from sysid_bench.types import Array

_PART: Final = 2**16
_LONGEST_TEXT: Final = 100_000
"""Letters of an attribute of HDF5."""

_STATED: Final = (
    f"its headers state {{}} bytes, more than there are or than the {LARGEST_LOG} that a log may "
    "have; write it again, or in parts"
)


@dataclass(frozen=True)
class NumpyArrays:
    """Numeric arrays of one length, npz by their names, npy by the index of its columns; the others
    in the file are skipped."""

    suffixes: ClassVar[tuple[str, ...]] = (".npz", ".npy")

    def read(self, path: Path) -> LogTable:
        """Return the arrays as columns; raises UsageError for a damaged file, one with pickled
        objects, and one with more numbers than LARGEST_LOG."""
        check_file(path, LARGEST_LOG)
        with library_errors(path, "an array file that can be read safely"), _opened(path) as arrays:
            return table_of_arrays(path, arrays)


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a file by their names; raises OSError, ValueError or what NumPy raises
    for a file with pickled objects, with more numbers than LARGEST_LOG, or another one."""
    check_file(path, LARGEST_LOG)
    with _opened(path) as arrays:
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
def _opened(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the arrays of a file by their names; raises ValueError for pickled ones, whose loading
    runs code of whoever wrote the file, and where headers state too much data."""
    with path.open("rb") as file:
        if file.read(2) != b"PK":
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            _header(file, size)
            file.seek(0)
            yield {"": np.load(file, allow_pickle=False)}
            return
        file.seek(0)
        with np.load(file, allow_pickle=False) as found:
            members = found.zip.infolist()
            if (total := sum(member.file_size for member in members)) > LARGEST_LOG:
                raise ValueError(_STATED.format(total))
            headers = {}
            for member in members:
                with found.zip.open(member) as part:
                    name = member.filename.removesuffix(".npy")
                    headers[name] = _header(part, member.file_size)
            arrays = {}
            for name in found.files:
                # Without a header NumPy has to say what an array is.
                header = headers.get(name)
                arrays[name] = _Member(found, name, *header) if header else found[name]
            yield arrays


def _header(part: IO[bytes], most: int) -> tuple[tuple[int, ...], Any] | None:
    """Return shape and type in the header of an array, None for something else.

    Raises ValueError where it states more than `most` bytes: NumPy would reserve them before
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
        raise ValueError(_STATED.format(size))
    return None if dtype.hasobject else (shape, dtype)


@dataclass(frozen=True)
class Matlab:
    """Numeric variables of one length, and fields of structs as "struct.field"; the others in the
    file are skipped. Version 7.3 is HDF5."""

    suffixes: ClassVar[tuple[str, ...]] = (".mat",)

    def read(self, path: Path) -> LogTable:
        """Return the variables as columns; raises UsageError for a damaged file."""
        import scipy.io  # 0.1 s, spent only where such a file is read

        check_file(path, LARGEST_LOG)
        with library_errors(path, "a MATLAB file that can be read"):
            try:
                size = sum(8 * math.prod(shape) for _, shape, _ in scipy.io.whosmat(path))
            except TypeError:  # objects of MATLAB have no shape; SciPy reads the other variables
                size = _unpacked_size(path)
            except NotImplementedError:
                return _read_hdf5(path, "", separator=".")
            check_size(path, size)
            found = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
        # Entries that SciPy adds begin with two underscores.
        named = {name: value for name, value in found.items() if not name.startswith("__")}
        return table_of_arrays(path, dict(_fields(named, "")))


def _unpacked_size(path: Path) -> int:
    """Return the bytes of the elements of a MATLAB 5 file, no more than are too many."""
    size = 0
    with path.open("rb") as file:
        file.seek(128)  # the first element
        while len(tag := file.read(8)) == 8 and size <= LARGEST_LOG:
            kind, count = struct.unpack("<II", tag)
            unpack = zlib.decompressobj().decompress if kind == 15 else bytes  # compressed or not
            while count > 0 and size <= LARGEST_LOG and (part := file.read(min(count, _PART))):
                count -= len(part)
                size += len(unpack(part))
    return size


def _fields(named: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Array]]:
    """Yield the numeric arrays of variables by name, recursing into structs."""
    for name, value in named.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            yield prefix + name, value
        inner = {field: getattr(value, field) for field in getattr(value, "_fieldnames", ())}
        yield from _fields(inner, f"{prefix}{name}.")


@dataclass(frozen=True)
class HDF5:
    """Numeric datasets of one length, named by their paths ("observations/qpos"), all of the file
    or those below `group`; the others are skipped. A robomimic file states its rate."""

    group: str = ""
    suffixes: ClassVar[tuple[str, ...]] = (".h5", ".hdf5")

    def read(self, path: Path) -> LogTable:
        """Return the datasets as columns; raises UsageError for a damaged file, an unknown group,
        data in other files, and more numbers than LARGEST_LOG."""
        return _read_hdf5(path, self.group)


def _read_hdf5(path: Path, group: str, separator: str = "/") -> LogTable:
    """Return the datasets of a group by name, and the rate (Hz) that the file states."""
    h5py = log_library("h5py", path)
    check_file(path, LARGEST_LOG)
    with library_errors(path, "an HDF5 file that can be read"), h5py.File(path, "r") as file:
        below = file.get(group) if group else file
        if not isinstance(below, h5py.Group):
            raise UsageError(f"{path} has no group {group!r}; at its top are {', '.join(file)}.")
        datasets = dict(_numeric_datasets(below, h5py.Dataset))
        size = sum(8 * math.prod(dataset.shape) for dataset in datasets.values())
        check_size(path, size, " Choose one part with reader = { use = 'hdf5', group = '...' }.")
        foreign = [name for name, x in datasets.items() if x.external or x.is_virtual]
        if foreign:
            raise UsageError(f"{path}: {foreign[0]!r} lies in another file; copy it into this one.")
        named = {name.replace("/", separator): dataset for name, dataset in datasets.items()}
        return replace(table_of_arrays(path, named), rate=_stated_rate(file))


def _numeric_datasets(group: Any, kind: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of numbers with one or two axes in a group of an HDF5 file, by name."""
    names: list[str] = []
    group.visit(names.append)  # links to other files are left
    for name in names:
        x: Any = None if name.startswith("#") else group[name]
        is_numeric = isinstance(x, kind) and x.ndim in (1, 2) and x.dtype.kind in "fiub"
        if is_numeric and x.attrs.get("MATLAB_class") != b"char":  # MATLAB keeps texts as numbers
            yield name, x


def _stated_rate(file: Any) -> float | None:
    """Return the rate of control (Hz) in the attribute env_args of robomimic, None without one."""
    data = file.get("data")
    text = data.attrs.get("env_args") if data is not None else None
    if not isinstance(text, str) or len(text) > _LONGEST_TEXT:
        return None
    try:
        settings = parse_json(text)
    except ValueError:
        return None
    for key in ("env_kwargs", "control_freq"):
        settings = settings.get(key) if isinstance(settings, Mapping) else None
    return float(settings) if isinstance(settings, (int, float)) and settings > 0 else None
