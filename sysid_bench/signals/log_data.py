"""Logs from numbers in memory: data frames, and mappings of arrays by name."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.signals.log_description import LogDescription, description_of
from sysid_bench.signals.log_keys import SIGNALS
from sysid_bench.signals.log_table import LogTable, table_of_arrays
from sysid_bench.types import Array

TIME: Final = "t"

LogLike = Any
"""Path of the description of a recording, its description, a data frame or a mapping of arrays."""

_WORDS: Final = {"q": "position", "v": "velocity", "tau": "effort"}
"""Words in the names of ROS columns, `<joint>_position`."""


def log_of(
    data: Any, description: Mapping[str, Any] | None = None, name: str = "data"
) -> LogDescription:
    """Return a log of numbers in memory: a data frame, or a mapping of arrays (N,) or (N, k).

    `description` has the keys of a log description without its files: joints, q, v, tau, rate or
    time, units, gains. What it leaves out follows from the names: the columns `q_<joint>`,
    `v_<joint>`, `tau_<joint>` or `<joint>_position`, `_velocity`, `_effort`, the arrays "q", "v"
    and "tau", and "t" (s); the numbers are SI. An index of dates is the time.

    Raises UsageError for other data, and for a description that does not fit them.
    """
    source = Path(name)
    table = table_of_arrays(source, _arrays(source, data))
    given = dict(description or {})
    written = [key for key in ("file", "reader") if key in given]
    if written:
        raise UsageError(f"{name}: {written[0]} is for recorded files; these numbers are given.")
    return description_of({**_by_convention(table, given), **given}, source, table)


def _is_data(value: Any) -> bool:
    """Test for a data frame or a mapping of arrays."""
    return isinstance(value, Mapping) or (hasattr(value, "columns") and hasattr(value, "to_numpy"))


def log_list(given: LogLike | Sequence[LogLike], name: str) -> tuple[Path | LogDescription, ...]:
    """Return paths of descriptions, and logs of numbers in memory, which are called `name`."""
    is_one = isinstance(given, (str, Path, LogDescription)) or _is_data(given)
    several = [given] if is_one else list(given)
    names = [name] if len(several) == 1 else [f"{name}{n}" for n in range(1, len(several) + 1)]
    return tuple(_log(one, label) for one, label in zip(several, names, strict=True))


def _log(given: LogLike, name: str) -> Path | LogDescription:
    if isinstance(given, LogDescription):
        return given
    return log_of(given, name=name) if _is_data(given) else Path(given)


def _arrays(source: Path, data: Any) -> dict[str, Array]:
    """Return arrays by name; stamps of time in s."""
    if not _is_data(data):
        raise UsageError(
            f"{source}: give a data frame or a mapping of arrays; got {type(data).__name__}."
        )
    keys = data.keys() if isinstance(data, Mapping) else data.columns
    found = {str(key).strip(): _numbers(np.asarray(data[key])) for key in keys}
    if len(found) < len(keys):
        raise UsageError(f"{source}: two columns have the same name; rename one.")
    if TIME not in found and _has_stamps(data):
        found[TIME] = _numbers(np.asarray(data.index))
    return found


def _has_stamps(data: Any) -> bool:
    """Test whether the index of a data frame holds times."""
    dtype = getattr(getattr(data, "index", None), "dtype", None)
    return dtype is not None and dtype.kind in "mM"


def _numbers(x: Any) -> Array:
    """Return an array as it is, dates and durations in s from the first one."""
    if x.dtype.kind not in "mM" or not len(x):
        return np.asarray(x)
    return np.asarray((x - x[0]) / np.timedelta64(1, "s"))


def _by_convention(table: LogTable, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that follow from the names of the columns."""
    keys: dict[str, Any] = {}
    if "joints" not in given:
        keys["joints"] = _joints(table)
    joints = given.get("joints", keys.get("joints"))
    keys |= _signal_keys(table, joints, given)
    if "time" not in given and "rate" not in given and TIME in table.names:
        keys["time"] = TIME
    return keys


def _signal_keys(
    table: LogTable, joints: Sequence[str], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the columns of the signals that are not `given`, where the table has them."""
    names = [signal for signal in SIGNALS if signal not in given]
    found = {signal: signal_columns(table.names, signal, joints) for signal in names}
    return {signal: {"columns": columns} for signal, columns in found.items() if columns}


def signal_columns(names: Any, signal: str, joints: Sequence[str]) -> list[str]:
    """Return the columns of a signal for some joints by the usual names, [] where they are not all
    there: one for each joint, or an array."""
    for pattern in (f"{signal}_{{}}", f"{{}}_{_WORDS.get(signal, signal)}"):
        columns = [pattern.format(joint) for joint in joints]
        if columns and set(columns).issubset(names):
            return columns
    array = (signal, _WORDS.get(signal, signal))
    return next(([name] for name in array if name in names), [])


def _joints(table: LogTable) -> list[str]:
    """Return the joints in the names of the columns.

    Raises UsageError where the names contain none.
    """
    names = list(table.names)
    found = _stems(names)
    if not found:
        raise UsageError(
            f"{table.path}: which joints? The columns {first_names(names, 6) or '(without names)'} "
            "do not name them; give log_of(data, {'joints': [...]})."
        )
    return found


def _stems(names: Sequence[str]) -> list[str]:
    """Return the names of joints in those of their positions, q_JOINT or else JOINT_position."""
    found = [name.removeprefix("q_") for name in names if name.startswith("q_")]
    return found or [name.removesuffix("_position") for name in names if name.endswith("_position")]
