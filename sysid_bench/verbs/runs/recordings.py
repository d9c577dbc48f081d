"""Recordings: execute a cell again and write it for the Rerun viewer.

Cells with third-party code are executed in a worker process, as in a run: what goes wrong there
costs the one recording, and its reason is kept in its place.
"""

import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.harness.run import job_of
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.work.worker_call import WorkerError, worker_call
from sysid_bench.input_files import read_text
from sysid_bench.metrics import ROW_FIELDS
from sysid_bench.reporting import view as viewer
from sysid_bench.units import quantity
from sysid_bench.verbs.runs.run_folder import find_cell, open_run, rows_with

MOST: Final = 20
"""Recordings that a run writes by itself; `record` writes more."""

MAX_HZ: Final = 50.0
"""Default sampling rate of recordings."""

_REASON: Final = "no_recording.txt"
_LONGEST_NOTE: Final = 100_000  # bytes
_EXECUTE: Final = "sysid_bench.verbs.runs.recordings:_write_cell"


def record(folder: str | Path, what: str, robots_dir: Path | None = None) -> list[Path]:
    """Write recordings of the cell with the id `what`, or of all that meet the expression `what`;
    return their paths. Raises UsageError for cells that have not run or that ended their process,
    and, when all others are written, for those that cannot be recorded.
    """
    run_folder = open_run(folder)
    chosen = [find_cell(run_folder, what)] if _is_id(what) else _matching(run_folder, what)
    if not chosen:
        raise UsageError(f"No finished cell of {str(folder)!r} meets {what!r}; nothing to record.")
    stored = run_folder.rows(frozenset(chosen)).rows
    for cell in chosen:
        _check_row(cell, stored.get(cell))
    attempts = [_attempt(run_folder, cell, stored[cell], robots_dir) for cell in chosen]
    _check_attempts(attempts)
    return [_path(run_folder, cell) for cell in chosen]


def _check_attempts(reasons: Sequence[str]) -> None:
    """Raise UsageError with the reasons of recordings that could not be written."""
    failures = list(filter(None, reasons))
    written = len(reasons) - len(failures)
    if failures:
        raise UsageError("\n".join([*failures, *([f"{written} written."] if written else [])]))


def _is_id(what: str) -> bool:
    """Test whether a text is a beginning of an id, and not an expression."""
    return set(what) <= set("0123456789abcdef")


def _check_row(cell: str, row: Mapping[str, Any] | None) -> None:
    """Raise UsageError for a cell that has not run, or that ended its process."""
    if row is None:
        raise UsageError(f"The cell {cell} has not run yet; run it first, then record it.")
    if row.get("status") in ("crash", "timeout", "memory"):
        raise UsageError(
            f"The cell {cell} ended as {row['status']}; executed again it would end the same way, "
            "without a recording. Record another cell of its experiment."
        )


def record_selection(
    run_folder: RunFolder, expression: str | None = None, robots_dir: Path | None = None
) -> list[Path]:
    """Write the recordings that a suite's [record] (or `expression`) selects, at most `MOST`, where
    they are absent or old. Cells without data (skipped, crash, timeout) are left out."""
    chosen = list(_matching(run_folder, expression) if expression else _by_rule(run_folder))
    if not chosen:
        return []
    stored = run_folder.rows(frozenset(chosen)).rows
    with_data = [c for c in dict.fromkeys(chosen) if stored[c].get("data_rank") is not None]
    newest = _newest_row(run_folder)
    written = []
    for cell in with_data[:MOST]:
        path = _path(run_folder, cell)
        if _last_attempt(path) > newest:
            continue
        if not _attempt(run_folder, cell, stored[cell], robots_dir):
            written.append(path)
    return written


def _last_attempt(recording: Path) -> float:
    """Time (s since the epoch) when a recording, or the reason for its absence, was written."""
    return max(map(_written_at, (recording, _reason_file(recording))))


def recording_notes(run_folder: RunFolder) -> tuple[str, ...]:
    """Return the reasons of the recordings that could not be written."""
    files = sorted((run_folder.path / "artifacts").glob(f"*/{_REASON}"))
    return tuple(map(_note, files))


def _note(file: Path) -> str:
    try:
        return read_text(file, largest=_LONGEST_NOTE).strip()
    except (OSError, UnicodeDecodeError) as error:
        return f"{file.parent.name}: its note cannot be read ({error})."


def _written_at(file: Path) -> float:
    """Time (s since the epoch) when a file was last written; -1 for an absent one."""
    return file.stat().st_mtime if file.is_file() else -1.0


def _newest_row(run_folder: RunFolder) -> float:
    """Time (s since the epoch) when a row was last written; 0 without rows."""
    return max(map(_written_at, (run_folder.path / "cells").glob("*.jsonl")), default=0.0)


def view(folder: str | Path, identifier: str, web: bool = False) -> subprocess.Popen[bytes]:
    """Open the recording of a cell, written first where it is absent; `web`: in the browser."""
    run_folder = open_run(folder)
    path = _path(run_folder, find_cell(run_folder, identifier))
    if not path.is_file():
        (path,) = record(folder, find_cell(run_folder, identifier))
    return viewer.view(path, web)


def _matching(run_folder: RunFolder, expression: str) -> list[str]:
    condition = Expression.parse(
        expression, run_folder.plan.fields | ROW_FIELDS | set(run_folder.suite.metrics)
    )
    met = rows_with(run_folder, condition)
    return [cell for cell in run_folder.planned if met.get(cell)]


def _by_rule(run_folder: RunFolder) -> Iterable[str]:
    rule = run_folder.suite.record
    if rule is None:
        return
    if rule.worst is not None:
        yield from _worst(run_folder, rule.worst.metric, rule.worst.count, rule.worst.per)
    if rule.when is not None:
        yield from _matching(run_folder, rule.when)


def _worst(run_folder: RunFolder, metric: str, count: int, per: str | None) -> Iterable[str]:
    rows = run_folder.frames().cells
    if metric not in rows:
        return
    measured = rows[rows[metric].notna()].sort_values(metric, ascending=False, kind="stable")
    # Cells of one group stand together, in the order in which the groups first occur.
    groups = [("", measured)] if per is None else measured.groupby(per, sort=False)
    for _, group in groups:
        yield from group["id"].head(count)


def _path(run_folder: RunFolder, cell: str) -> Path:
    return run_folder.path / "artifacts" / cell / "recording.rrd"


def _reason_file(recording: Path) -> Path:
    return recording.with_name(_REASON)


def _attempt(
    run_folder: RunFolder, cell: str, row: Mapping[str, Any], robots_dir: Path | None
) -> str:
    """Write the recording of a cell, or the reason why it cannot be; return the reason, else ""."""
    path = _path(run_folder, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    reason = ""
    try:
        _write(run_folder, cell, row, robots_dir)
    except WorkerError as error:
        reason = str(error)
    except Exception as error:  # a missing recording does not fail a run
        reason = f"The recording of {cell} could not be written: {reason_of(error)}"
    if reason:
        _reason_file(path).write_text(f"{reason}\n", encoding="utf-8")
        for old in path.parent.glob(f"{path.name}*"):  # of an older row, or unfinished
            old.unlink()
    else:
        _reason_file(path).unlink(missing_ok=True)
    return reason


def _job(run_folder: RunFolder, cell: str, robots_dir: Path | None) -> dict[str, Any]:
    # A recording needs the signals, which rows do not hold: the cell is executed again.
    (planned,) = [c for c in run_folder.plan.cells if c.id == cell]
    return job_of([planned], run_folder.suite, robots_dir or run_folder.suite.robots_folder)


def _write(
    run_folder: RunFolder, cell: str, row: Mapping[str, Any], robots_dir: Path | None
) -> None:
    rule = run_folder.suite.record
    job = _job(run_folder, cell, robots_dir)
    argument = {
        "job": job,
        "row": dict(row),
        "path": str(_path(run_folder, cell).resolve()),
        "max_hz": quantity(rule.max_hz if rule else MAX_HZ, "Hz"),
    }
    if any(job["third_party"].values()):
        limits = run_folder.suite.run
        title = f"The recording of {cell} ({row.get('estimator')}) could not be written"
        timeout, memory = quantity(limits.timeout, "s"), quantity(limits.memory, "B")
        worker_call(_EXECUTE, argument, title, timeout, memory)
    else:
        _write_cell(argument)


def _write_cell(argument: Mapping[str, Any], channel: JobChannel | None = None) -> None:
    """Execute a cell and write its recording."""
    from sysid_bench.experiments.cell_data import cell_data  # loads the simulation
    from sysid_bench.reporting import recording as cell_recording

    data = cell_data(argument["job"], argument["row"])
    cell_recording.record(data, Path(argument["path"]), argument["max_hz"])
