"""Table of numbers that a log reader returns: columns by index from 1, or by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, first_names, unknown_name
from sysid_bench.signals.log_keys import preset_note
from sysid_bench.signals.log_library import report
from sysid_bench.types import Array

LARGEST_LOG: Final = 2**30
"""Bytes of a recorded file, and of its numbers once they are unpacked."""


_SHORT: Final = 100
"""Entries of an array that is not a series of samples, but one number or word for each joint."""


def check_size(path: Path, size: int, advice: str = "") -> None:
    """Raise UsageError for a file that unpacks to more bytes than a log may have."""
    if size > LARGEST_LOG:
        raise UsageError(
            f"{path} unpacks to {size} bytes; {LARGEST_LOG} are allowed at most.{advice}"
        )


@dataclass(frozen=True, eq=False)
class LogTable:
    """Numbers (N, c) of a file, NaN for empty cells; `names` maps a name to the indices (from 0) of
    its columns, several for an array; `truncated`: number of incomplete samples dropped at its
    end; `rate` (Hz) that the file states; `unit_doubt`: why its positions need a stated unit;
    `constants`: short lists of numbers or words beside the samples, such as gains."""

    path: Path
    values: Array
    names: Mapping[str, tuple[int, ...]]
    truncated: int = 0
    rate: float | None = None
    unit_doubt: str = ""
    constants: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)

    def columns(self, chosen: Sequence[int | str]) -> Array:
        """Return (N, k) of columns by index from 1 or by name.

        Raises UsageError with the nearest names, or the number of columns.
        """
        indices: list[int] = []
        for column in chosen:
            if isinstance(column, str):
                if column.strip() not in self.names:
                    advice = "Give columns by their index, from 1."
                    if self.names:
                        advice = preset_note(self.names).strip()
                    error = unknown_name("column", column.strip(), self.names, advice)
                    raise UsageError(f"{self.path}: {error}")
                indices += self.names[column.strip()]
            elif 1 <= column <= self.values.shape[1]:
                indices.append(column - 1)
            else:
                raise UsageError(
                    f"{self.path} has {self.values.shape[1]} columns, counted from 1; there is no "
                    f"column {column}."
                )
        return self.values[:, indices]


def table_of_rows(table: LogTable, per_row: int) -> LogTable:
    """Return a file with one number a line as samples of `per_row` consecutive numbers.

    An incomplete last sample is dropped and counted. Raises UsageError for several columns.
    """
    if table.values.shape[1] != 1:
        raise UsageError(
            f"{table.path} has {table.values.shape[1]} columns; per_row is for files with one "
            "number a line."
        )
    flat = table.values.ravel()
    samples, incomplete = divmod(len(flat), per_row)
    values = flat[: samples * per_row].reshape(samples, per_row)
    return LogTable(table.path, values, {}, table.truncated + (incomplete > 0))


def column_names(path: Path, names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the index of each named column; "" is a column without a name.

    Raises UsageError for a name that two columns have.
    """
    found: dict[str, tuple[int, ...]] = {}
    for index, name in enumerate(names):
        if name in found:
            raise UsageError(
                f"{path}: columns {found[name][0] + 1} and {index + 1} are both named {name!r}; "
                "rename one."
            )
        if name:
            found[name] = (index,)
    return found


def table_of_arrays(path: Path, arrays: Mapping[str, Any]) -> LogTable:
    """Return the arrays of the greatest length N as columns: (N,) is one, (N, k) or (k, N) are k.

    Column i of an array "q" is also named "q:i", from 1. Raises UsageError without numbers, and for
    a list in place of an array, which a reader of one's own may return.
    """
    numeric = _numeric_arrays(path, arrays)
    N = max((max(x.shape) for x in numeric.values()), default=0)
    if N == 0:
        raise UsageError(f"{path} holds no array of numbers.")
    kept = {name: x for name, x in numeric.items() if N in x.shape}
    listed = {name: x for name, x in arrays.items() if getattr(x, "ndim", 0) == 1}
    constants = {
        name: tuple(np.asarray(x).tolist())
        for name, x in listed.items()
        if 0 < x.shape[0] < min(N, _SHORT) and x.dtype.kind in "fiuU"
    }
    if len(kept) == 1:
        ((name, x),) = kept.items()
        values = _time_by_rows(np.asarray(x, dtype=float), N)
        only = array_names(name, range(values.shape[1]))
        return LogTable(path, values, only, constants=constants)
    widths = [1 if x.ndim == 1 else x.size // N for x in kept.values()]
    # Arrays that lie in a file are read one by one, so that memory holds the table and one of them.
    values, first = np.empty((N, sum(widths))), 0
    names: dict[str, tuple[int, ...]] = {}
    for (name, x), width in zip(kept.items(), widths, strict=True):
        values[:, first : first + width] = _time_by_rows(np.asarray(x), N)
        names |= array_names(name, range(first, first + width))
        first += width
        report(path, first, values.shape[1])
    return LogTable(path, values, names, constants=constants)


def _numeric_arrays(path: Path, arrays: Mapping[str, Any]) -> dict[str, Any]:
    if lists := [name for name, x in arrays.items() if isinstance(x, list | tuple)]:
        raise UsageError(f"{path}: {first_names(lists)} is a list; give numpy.asarray of it.")
    return {
        name: x
        for name, x in arrays.items()
        if getattr(x, "ndim", 0) in (1, 2) and x.dtype.kind in "fiub"
    }


def _time_by_rows(x: Array, N: int) -> Array:
    """Return x as (N, k): MATLAB users keep time along columns as often as along rows."""
    if x.ndim == 1:
        return x[:, None]
    return x if len(x) == N else x.T


def columns_with_names(
    path: Path, arrays: Mapping[str, tuple[Array, Sequence[str]]]
) -> tuple[Array, dict[str, tuple[int, ...]]]:
    """Return values (N, c) and names of arrays (N, k), each with the names of its columns.

    An array of several columns has a name of its own besides those of its columns, () for numbers
    from 1. Raises UsageError for a name that two of them have.
    """
    names: dict[str, tuple[int, ...]] = {}
    first = 0
    for name, (array, words) in arrays.items():
        found = array_names(name, range(first, first + array.shape[1]), words)
        first += array.shape[1]
        twice = names.keys() & found.keys()
        if twice:
            raise UsageError(f"{path}: two columns are named {min(twice)!r}; rename one.")
        names |= found
    parts = [array for array, _ in arrays.values()]
    whole = parts[0].base
    # No copy of parts that were made side by side in one array, and fill it.
    if whole is not None and whole.shape == (len(parts[0]), first):
        starts = np.cumsum([0, *(8 * x.shape[1] for x in parts[:-1])])
        places = [x.ctypes.data - whole.ctypes.data for x in parts]
        if all(x.base is whole for x in parts) and places == starts.tolist():
            return np.asarray(whole), names
    return np.concatenate(parts, axis=1), names


def array_names(name: str, indices: range, words: Sequence[str] = ()) -> dict[str, tuple[int, ...]]:
    """Return the names of an array's columns: its own for all of them, and, of several, one each:
    `words`, or numbers from 1.

    An array without a name has none.
    """
    if not name:
        return {}
    chosen = words or [f"{name}:{c}" for c in range(1, len(indices) + 1)]
    each = {word: (index,) for word, index in zip(chosen, indices, strict=True)}
    return {name: tuple(indices), **(each if len(each) > 1 else {})}
