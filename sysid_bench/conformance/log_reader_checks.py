"""Conformance kit of log readers: what a plug-in owes `identify --log`.

`read(path)` gives a LogTable of a recorded file. The kit writes files of common formats itself; for
another format, or another dialect of one, it takes a recorded file.
"""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sysid_bench.conformance.findings import Finding, finding_of_error, findings_of
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.signals.log_table import LogTable
from sysid_bench.types import Array

READS: Final = "reads a recorded file"


@dataclass(frozen=True, eq=False)
class LogCase:
    """A recorded file that the reader has to read."""

    name: str
    file: Path


Law = Callable[[Any, LogCase, LogTable], str | None]
"""(reader, case, the table of its file) -> description of the violation, or None."""


def check_log_reader(reader: Any, file: Path | None = None) -> list[Finding]:
    """Findings of all laws on a recorded file; None: on files that the kit writes, one for each
    common suffix of the reader.

    Raises UsageError where the kit has no file to read.
    """
    findings = findings_of(DECLARED, "its declaration", reader)
    if not findings[0].passed:  # files are chosen by suffix
        return findings
    if file is not None:
        return findings + _findings_on(reader, LogCase(file.name, file))
    return findings + _findings_on_written(reader)


def _findings_on_written(reader: Any) -> list[Finding]:
    """Findings on a file of the kit for each common suffix of the reader."""
    formats = [suffix for suffix in reader.suffixes if suffix in WRITERS]
    if not formats:
        raise UsageError(
            f"A log reader for {', '.join(reader.suffixes) or 'no suffix'} is checked on a "
            f"recorded file: name one with --file FILE. Only {', '.join(WRITERS)} files are "
            "written by the check itself."
        )
    findings = []
    with tempfile.TemporaryDirectory() as folder:
        for suffix in formats:
            written = Path(folder, f"written{suffix}")
            WRITERS[suffix](written)
            findings += _findings_on(reader, LogCase(f"a {suffix} file of the kit", written))
    return findings


def _findings_on(reader: Any, case: LogCase) -> list[Finding]:
    try:
        table = reader.read(case.file)
    except Exception as error:
        return [finding_of_error(error, READS, case.name)]
    if not isinstance(table, LogTable):
        message = f"read() returned {type(table).__name__}, not a LogTable"
        return [Finding(READS, case.name, False, message)]
    return findings_of(LAWS, case.name, reader, case, table)


def _has_suffixes(reader: Any) -> str | None:
    wrong = [s for s in reader.suffixes if not s.startswith(".") or s != s.lower()]
    return f"suffixes: {wrong[0]!r} must start with a dot and be lower case" if wrong else None


def _can_be_hashed(reader: Any) -> str | None:
    """Tables are cached by reader and file."""
    try:
        hash(reader)
    except TypeError:
        return "it cannot be hashed: make it a frozen dataclass"
    return None


def _gives_numbers(reader: Any, case: LogCase, table: LogTable) -> str | None:
    """Floats (N, c), N and c above zero, some of them finite."""
    values = table.values
    if values.ndim != 2 or values.dtype.kind != "f" or not values.size:
        return f"values are {values.dtype} {values.shape}; floats (N, c) are required"
    return None if np.isfinite(values).any() else "values hold no finite number"


def _names_columns(reader: Any, case: LogCase, table: LogTable) -> str | None:
    """Names stand for columns of the table."""
    columns = range(table.values.shape[1])
    outside = [name for name, indices in table.names.items() if not set(indices) <= set(columns)]
    if not outside:
        return None
    return f"name {outside[0]!r} stands for columns outside of 0 ... {len(columns) - 1}"


def _names_a_column_once(reader: Any, case: LogCase, table: LogTable) -> str | None:
    """An array may have a name besides those of its columns."""
    single = [indices for indices in table.names.values() if len(indices) == 1]
    return "two names stand for the same column" if len(set(single)) < len(single) else None


def _is_deterministic(reader: Any, case: LogCase, table: LogTable) -> str | None:
    again = reader.read(case.file)
    # Empty cells are NaN, which equals nothing.
    same = np.array_equal(table.values, again.values, equal_nan=True)
    if same and dict(table.names) == dict(again.names):
        return None
    return "two calls return different tables"


def _refuses_an_empty_file(reader: Any, case: LogCase, table: LogTable) -> str | None:
    return _accepts_damage("an empty file", reader, case, table, 0)


def _refuses_a_truncated_file(reader: Any, case: LogCase, table: LogTable) -> str | None:
    """A format of lines may yield fewer samples: a logger that was stopped leaves such files."""
    half = case.file.stat().st_size // 2
    return _accepts_damage("a truncated file", reader, case, table, half)


def _accepts_damage(
    damage: str, reader: Any, case: LogCase, table: LogTable, size: int
) -> str | None:
    """Violation where the first `size` bytes of the file give neither a UsageError nor fewer
    samples than all of it."""
    with tempfile.TemporaryDirectory() as folder:
        damaged = Path(folder, case.file.name)
        damaged.write_bytes(case.file.read_bytes()[:size])
        try:
            left = len(reader.read(damaged).values)
        except UsageError:
            return None
        except Exception as error:
            return f"{damage} raised {reason_of(error)}; raise UsageError"
    if 0 < left < len(table.values):
        return None
    return f"{damage} gives {left} samples; raise UsageError"


DECLARED: Final[dict[str, Callable[[Any], str | None]]] = {
    "declares its suffixes": _has_suffixes,
    "can be hashed": _can_be_hashed,
}
LAWS: Final[dict[str, Law]] = {
    "gives numbers": _gives_numbers,
    "names columns of its table": _names_columns,
    "names a column once": _names_a_column_once,
    "is deterministic": _is_deterministic,
    "refuses an empty file": _refuses_an_empty_file,
    "refuses a truncated file": _refuses_a_truncated_file,
}


_NAMES: Final = ("t", "q1", "q2", "tau1", "tau2")


def _signals() -> dict[str, Any]:
    """Time (s), position (rad) and torque (N m) of two joints, 200 samples."""
    t = np.arange(200) / 100.0
    q = np.sin(np.outer(t, (1.0, 2.0)))
    return {"t": t, "q": q, "tau": -9.81 * q}


def _matrix() -> Array:
    """The same signals as columns `_NAMES`, (200, 5)."""
    return np.column_stack(list(_signals().values()))


def _write_text(file: Path) -> None:
    np.savetxt(file, _matrix(), delimiter=",", header=",".join(_NAMES), comments="")


def _write_npz(file: Path) -> None:
    np.savez(file, **_signals())


def _write_npy(file: Path) -> None:
    np.save(file, _matrix())


def _write_mat(file: Path) -> None:
    from scipy.io import savemat  # 0.1 s, spent only where such a reader is checked

    savemat(file, _signals())


def _write_parquet(file: Path) -> None:
    from pyarrow import parquet, table  # 0.2 s, spent only where such a reader is checked

    parquet.write_table(table(dict(zip(_NAMES, _matrix().T, strict=True))), file)


WRITERS: Final[Mapping[str, Callable[[Path], None]]] = {
    ".csv": _write_text,
    ".txt": _write_text,
    ".npz": _write_npz,
    ".npy": _write_npy,
    ".mat": _write_mat,
    ".parquet": _write_parquet,
}
"""Common formats by suffix, with a function that writes a small recording."""
