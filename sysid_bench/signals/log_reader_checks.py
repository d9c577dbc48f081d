"""Check kit for log readers: what a plug-in owes `identify --log`."""

import tempfile
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.signals.log_reader import LogReader
from sysid_bench.signals.log_table import LogTable


def check_log_reader(reader: LogReader, path: Path) -> list[str]:
    """Return the requirements that a reader breaks on a good file, a line each; none: it conforms.

    Values are (N, c) floats, N and c above zero, names are unique, a second call returns the same,
    an empty or truncated copy raises UsageError or, in a format of lines, yields fewer samples.
    """
    return list(chain(_broken_declaration(reader), _broken_reading(reader, path)))


def _broken_declaration(reader: LogReader) -> Iterator[str]:
    for suffix in reader.suffixes:
        if not suffix.startswith(".") or suffix != suffix.lower():
            yield f"suffixes: {suffix!r} must start with a dot and be lower case"
    try:
        hash(reader)
    except TypeError:
        yield "it cannot be hashed: make it a frozen dataclass"


def _broken_reading(reader: LogReader, path: Path) -> Iterator[str]:
    try:
        table, again = reader.read(path), reader.read(path)
    except Exception as error:
        yield f"reading {path.name} raised {reason_of(error)}"
        return
    if not isinstance(table, LogTable):
        yield f"read() returned {type(table).__name__}, not a LogTable"
        return
    yield from _broken_table(table)
    same = np.array_equal(table.values, again.values, equal_nan=True)
    if not same or dict(table.names) != dict(again.names):
        yield "two calls return different tables"
    content = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        damaged = Path(folder, path.name)
        for what, size in (("an empty file", 0), ("a truncated file", len(content) // 2)):
            damaged.write_bytes(content[:size])
            yield from _broken_refusal(what, lambda: reader.read(damaged), len(table.values))


def _broken_table(table: LogTable) -> Iterator[str]:
    values = table.values
    if values.ndim != 2 or values.dtype.kind != "f" or not values.size:
        yield f"values are {values.dtype} {values.shape}; floats (N, c) are required"
        return
    if not np.isfinite(values).any():
        yield "values hold no finite number"
    c = values.shape[1]
    outside = [name for name, indices in table.names.items() if not set(indices) <= set(range(c))]
    if outside:
        yield f"name {outside[0]!r} stands for columns outside of 0 ... {c - 1}"
    single = [indices for indices in table.names.values() if len(indices) == 1]
    if len(set(single)) < len(single):
        yield "two names stand for the same column"


def _broken_refusal(what: str, read: Callable[[], LogTable], samples: int) -> Iterator[str]:
    try:
        left = len(read().values)
    except UsageError:
        return
    except Exception as error:
        yield f"{what} raised {reason_of(error)}; raise UsageError"
        return
    if not 0 < left < samples:
        yield f"{what} gives {left} samples; raise UsageError"
