"""Logs from numbers in memory: data frames, and mappings of arrays by name."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names
from sysid_bench.signals.column_names import usual_columns
from sysid_bench.signals.log_description import LogDescription, description_of
from sysid_bench.signals.log_keys import SIGNALS
from sysid_bench.signals.log_table import LogTable, table_of_arrays
from sysid_bench.types import Array

TIME: Final = "t"

LogLike = Any
"""Path of the description of a recording, its description, a data frame or a mapping of arrays."""


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
    for key in ("file", "reader"):
        if key in given:
            raise UsageError(f"{name}: {key} is for recorded files; these numbers are given.")
    if "joints" not in given:
        given["joints"] = _joints(table)
    for signal in SIGNALS:
        columns = usual_columns(table.names, signal, given["joints"])
        if columns:
            given.setdefault(signal, {"columns": columns})
    if "rate" not in given and TIME in table.names:
        given.setdefault("time", TIME)
    return description_of(given, source, table)


def _is_data(value: Any) -> bool:
    """Test for a data frame or a mapping of arrays."""
    return isinstance(value, Mapping) or (hasattr(value, "columns") and hasattr(value, "to_numpy"))


def log_list(given: LogLike | Sequence[LogLike], name: str) -> tuple[Path | LogDescription, ...]:
    """Return paths of descriptions, and logs of numbers in memory, which are called `name`."""
    is_one = isinstance(given, (str, Path, LogDescription)) or _is_data(given)
    logs: list[Path | LogDescription] = []
    for n, one in enumerate([given] if is_one else list(given), start=1):
        if isinstance(one, LogDescription):
            logs.append(one)
        elif _is_data(one):
            logs.append(log_of(one, name=name if is_one or len(given) == 1 else f"{name}{n}"))
        else:
            logs.append(Path(one))
    return tuple(logs)


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
    index = getattr(data, "index", None)
    if TIME not in found and getattr(index, "dtype", np.dtype(float)).kind in "mM":
        found[TIME] = _numbers(np.asarray(index))
    return found


def _numbers(x: Any) -> Array:
    """Return an array as it is, dates and durations in s from the first one."""
    if x.dtype.kind not in "mM" or not len(x):
        return np.asarray(x)
    return np.asarray((x - x[0]) / np.timedelta64(1, "s"))


def _joints(table: LogTable) -> list[str]:
    """Return the joints in the names of their positions, q_JOINT or else JOINT_position; raises
    UsageError where the names contain none."""
    names, end = list(table.names), "_position"
    found = [name.removeprefix("q_") for name in names if name.startswith("q_")]
    found = found or [name.removesuffix(end) for name in names if name.endswith(end)]
    if not found:
        raise UsageError(
            f"{table.path}: which joints? The columns {first_names(names, 6) or '(without names)'} "
            "do not name them; give log_of(data, {'joints': [...]})."
        )
    return found
