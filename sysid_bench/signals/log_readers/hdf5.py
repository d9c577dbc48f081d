"""HDF5 files: datasets by their paths in the file, and variables of MATLAB 7.3 files."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from sysid_bench.errors import UsageError
from sysid_bench.input_files import check_file, parse_json
from sysid_bench.signals.library_errors import library_errors
from sysid_bench.signals.log_library import log_library
from sysid_bench.signals.log_table import LARGEST_LOG, LogTable, table_of_arrays

_LONGEST_TEXT = 100_000  # of an attribute


@dataclass(frozen=True)
class HDF5:
    """Numeric datasets of one length, named by their paths ("observations/qpos"), all of the file
    or those below `group`; the others are skipped. A robomimic file states its rate."""

    group: str = ""
    suffixes: ClassVar[tuple[str, ...]] = (".h5", ".hdf5")

    def read(self, path: Path) -> LogTable:
        """Return the datasets as columns; raises UsageError for a damaged file, an unknown group,
        data in other files, and more numbers than LARGEST_LOG."""
        return _read(path, self.group)


def read_matlab_73(path: Path) -> LogTable:
    """Return the variables of a MATLAB 7.3 file as columns, fields of structs as "struct.field"."""
    return _read(path, "", separator=".")


def _read(path: Path, group: str, separator: str = "/") -> LogTable:
    """Return the datasets of a group by name, and the rate (Hz) that the file states."""
    h5py = log_library("h5py", path)
    check_file(path, LARGEST_LOG)
    with library_errors(path, "an HDF5 file"), h5py.File(path, "r") as file:
        found = _datasets(h5py, path, _group_of(h5py, path, file, group))
        named = {name.replace("/", separator): dataset for name, dataset in found.items()}
        return replace(table_of_arrays(path, named), rate=_stated_rate(file))


def _group_of(h5py: Any, path: Path, file: Any, name: str) -> Any:
    if not name:
        return file
    found = file.get(name)
    if not isinstance(found, h5py.Group):
        raise UsageError(f"{path} has no group {name!r}; at its top are {', '.join(file)}.")
    return found


def _datasets(h5py: Any, path: Path, group: Any) -> dict[str, Any]:
    """Return the numeric datasets of a group; raises UsageError for too many numbers, or for data
    in other files."""
    datasets = dict(_numeric_datasets(h5py, group))
    size = sum(8 * math.prod(dataset.shape) for dataset in datasets.values())
    if size > LARGEST_LOG:
        raise UsageError(
            f"{path} unpacks to {size} bytes; {LARGEST_LOG} are allowed at most. Choose one part "
            "with reader = { use = 'hdf5', group = '...' }."
        )
    foreign = [name for name, dataset in datasets.items() if dataset.external or dataset.is_virtual]
    if foreign:
        raise UsageError(f"{path}: {foreign[0]!r} lies in another file; copy it into this one.")
    return datasets


def _numeric_datasets(h5py: Any, group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of one or two dimensions of numbers; links to other files are left."""
    names: list[str] = []
    group.visit(names.append)
    for name in names:
        dataset = group[name]
        if isinstance(dataset, h5py.Dataset) and not name.startswith("#") and _is_numeric(dataset):
            yield name, dataset


def _is_numeric(dataset: Any) -> bool:
    # MATLAB keeps texts as numbers.
    is_text = dataset.attrs.get("MATLAB_class") == b"char"
    return dataset.ndim in (1, 2) and dataset.dtype.kind in "fiub" and not is_text


def _stated_rate(file: Any) -> float | None:
    """Return the rate of control (Hz) in the attribute env_args of robomimic, None without one."""
    data = file.get("data")
    text = data.attrs.get("env_args") if data is not None else None
    if not isinstance(text, str) or len(text) > _LONGEST_TEXT:
        return None
    rate = _control_rate(text)
    return float(rate) if isinstance(rate, (int, float)) and rate > 0 else None


def _control_rate(text: str) -> Any:
    try:
        return _settings(_settings(parse_json(text)).get("env_kwargs")).get("control_freq")
    except ValueError:
        return None


def _settings(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
