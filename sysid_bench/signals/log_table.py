"""Table of numbers that a log reader returns: columns by index from 1, or by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.signals.log_preset import preset_note
from sysid_bench.signals.read_progress import report
from sysid_bench.types import Array

LARGEST_LOG: Final = 2**30
"""Bytes of a recorded file, and of its numbers once they are unpacked."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """Numbers (N, c) of a file, NaN for empty cells; `names` maps a name to the indices (from 0) of
    its columns, several for an array; `truncated`: number of incomplete samples dropped at its
    end; `rate` (Hz) that the file states; `unit_doubt`: why its positions need a stated unit."""

    path: Path
    values: Array
    names: Mapping[str, tuple[int, ...]]
    truncated: int = 0
    rate: float | None = None
    unit_doubt: str = ""

    def columns(self, chosen: Sequence[int | str]) -> Array:
        """Return (N, k) of columns by index from 1 or by name.

        Raises UsageError with the nearest names, or the number of columns.
        """
        indices: list[int] = []
        for column in chosen:
            indices += self._indices(column)
        return self.values[:, indices]

    def _indices(self, column: int | str) -> tuple[int, ...]:
        if isinstance(column, str):
            return self._named(column.strip())
        if not 1 <= column <= self.values.shape[1]:
            raise UsageError(
                f"{self.path} has {self.values.shape[1]} columns, counted from 1; there is no "
                f"column {column}."
            )
        return (column - 1,)

    def _named(self, name: str) -> tuple[int, ...]:
        if name not in self.names:
            advice = preset_note(self.names).strip()
            if not self.names:
                advice = "Give columns by their index, from 1."
            raise UsageError(f"{self.path}: {unknown_name('column', name, self.names, advice)}")
        return self.names[name]


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
    samples = len(flat) // per_row
    values = flat[: samples * per_row].reshape(samples, per_row)
    incomplete = 1 if len(flat) % per_row else 0
    return LogTable(table.path, values, {}, table.truncated + incomplete)


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


def _longest(arrays: Mapping[str, Any]) -> tuple[dict[str, Any], int]:
    """Return the arrays of numbers of the greatest length, and that length."""
    numeric = {name: x for name, x in arrays.items() if _is_numeric(x)}
    N = max((max(x.shape) for x in numeric.values()), default=0)
    return {name: x for name, x in numeric.items() if N in x.shape}, N


def table_of_arrays(path: Path, arrays: Mapping[str, Any]) -> LogTable:
    """Return the arrays of the greatest length N as columns: (N,) is one, (N, k) or (k, N) are k.

    Column i of an array "q" is also named "q:i", from 1. Raises UsageError without numbers.
    """
    kept, N = _longest(arrays)
    if N == 0:
        raise UsageError(f"{path} holds no array of numbers.")
    widths = {name: 1 if x.ndim == 1 else x.size // N for name, x in kept.items()}
    if len(kept) == 1:
        (x,) = kept.values()
        return LogTable(
            path, _time_by_rows(np.asarray(x, dtype=float), N), _names_of_widths(widths)
        )
    # Arrays that lie in a file are read one by one, so that memory holds the table and one of them.
    values, first = np.empty((N, sum(widths.values()))), 0
    for name, x in kept.items():
        values[:, first : first + widths[name]] = _time_by_rows(np.asarray(x), N)
        first += widths[name]
        report(path, first, values.shape[1])
    return LogTable(path, values, _names_of_widths(widths))


def _is_numeric(x: Any) -> bool:
    """Return true for an array of one or two dimensions of floats, integers or booleans."""
    return getattr(x, "ndim", 0) in (1, 2) and x.dtype.kind in "fiub"


def columns_with_names(
    path: Path, arrays: Mapping[str, tuple[Array, Sequence[str]]]
) -> tuple[Array, dict[str, tuple[int, ...]]]:
    """Return values (N, c) and names of arrays (N, k), each with the names of its columns.

    An array of several columns has a name of its own besides those of its columns, () for numbers
    from 1. Raises UsageError for a name that two of them have.
    """
    parts = [array for array, _ in arrays.values()]
    names: dict[str, tuple[int, ...]] = {}
    for name, (array, words) in arrays.items():
        first = sum(part.shape[1] for part in parts[: list(arrays).index(name)])
        found = _array_names(name, range(first, first + array.shape[1]), words)
        twice = names.keys() & found.keys()
        if twice:
            raise UsageError(f"{path}: two columns are named {min(twice)!r}; rename one.")
        names |= found
    return _side_by_side(parts), names


def _side_by_side(parts: Sequence[Array]) -> Array:
    """Return arrays (N, k) as one: without a copy where they are the parts of one already."""
    whole = parts[0].base
    if whole is not None and _is_made_of(whole, parts):
        return np.asarray(whole)
    return np.concatenate(parts, axis=1)


def _is_made_of(whole: Array, parts: Sequence[Array]) -> bool:
    """Test whether the parts (N, k) lie side by side in an array and fill it."""
    starts = np.cumsum([0, *(x.shape[1] for x in parts)]).tolist()
    places = zip(parts, starts[:-1], strict=True)
    return whole.shape == (len(parts[0]), starts[-1]) and all(
        x.base is whole and _offset(x) - _offset(whole) == 8 * at for x, at in places
    )


def _offset(x: Array) -> int:
    """Return the place of an array in memory (bytes)."""
    address: int = x.__array_interface__["data"][0]
    return address


def _time_by_rows(x: Array, N: int) -> Array:
    """Return x as (N, k): MATLAB users keep time along columns as often as along rows."""
    if x.ndim == 1:
        return x[:, None]
    return x if len(x) == N else x.T


def _names_of_widths(widths: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Return the indices that each name stands for, arrays of these widths side by side."""
    names: dict[str, tuple[int, ...]] = {}
    first = 0
    for name, width in widths.items():
        names |= _array_names(name, range(first, first + width))
        first += width
    return names


def _array_names(
    name: str, indices: range, words: Sequence[str] = ()
) -> dict[str, tuple[int, ...]]:
    """Return the names of an array's columns: its own for all of them, and, of several, one each:
    `words`, or numbers from 1.

    An array without a name has none.
    """
    if not name:
        return {}
    chosen = words or [f"{name}:{c}" for c in range(1, len(indices) + 1)]
    each = {word: (index,) for word, index in zip(chosen, indices, strict=True)}
    return {name: tuple(indices), **(each if len(each) > 1 else {})}
