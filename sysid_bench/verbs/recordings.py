"""Recordings: execute a cell again and write it for the Rerun viewer."""

import subprocess
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.experiments.cell_data import cell_data
from sysid_bench.harness.job import job_of
from sysid_bench.harness.plan import fields
from sysid_bench.harness.store import RunFolder
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.reporting.cell_recording import record as write_recording
from sysid_bench.reporting.cell_recording import view as open_viewer
from sysid_bench.units import quantity
from sysid_bench.verbs.folders import find_cell, open_run
from sysid_bench.vocabulary import ROW_FIELDS

MOST: Final = 20
"""Recordings that a run writes by itself; `record` writes more."""

MAX_HZ: Final = 50.0
"""Default sampling rate of recordings."""


def record(folder: str | Path, what: str, robots_dir: Path | None = None) -> list[Path]:
    """Write recordings of the cell with the id `what`, or of all that meet the expression `what`;
    return their paths. Raises UsageError for cells that have not run or that ended their process.
    """
    run_folder = open_run(folder)
    stored = run_folder.rows().rows
    chosen = [find_cell(run_folder, what)] if _is_id(what) else _matching(run_folder, what)
    if not chosen:
        raise UsageError(f"No finished cell of {str(folder)!r} meets {what!r}; nothing to record.")
    for cell in chosen:
        _check_row(cell, stored.get(cell))
    return [_write(run_folder, cell, stored[cell], robots_dir) for cell in chosen]


def _is_id(what: str) -> bool:
    """Test whether a text is a beginning of an id, and not an expression."""
    return set(what) <= set("0123456789abcdef")


def _check_row(cell: str, row: Mapping[str, Any] | None) -> None:
    """Raise UsageError for a cell that has not run, or that ended its process."""
    if row is None:
        raise UsageError(f"The cell {cell} has not run yet; run it first, then record it.")
    if row.get("status") in ("crash", "timeout"):
        raise UsageError(
            f"The cell {cell} ended as {row['status']}; executed again here it would "
            "take this command with it. Record another cell of its experiment."
        )


def record_selected(
    run_folder: RunFolder, expression: str | None = None, robots_dir: Path | None = None
) -> list[Path]:
    """Write the recordings that a suite's [record] (or `expression`) selects, at most `MOST`, where
    they are absent or old. Cells without data (skipped, crash, timeout) are left out."""
    chosen = list(_matching(run_folder, expression) if expression else _by_rule(run_folder))
    if not chosen:
        return []
    stored = run_folder.rows().rows
    with_data = [c for c in dict.fromkeys(chosen) if stored[c].get("data_rank") is not None]
    newest = _newest_row(run_folder)
    written = []
    for cell in with_data[:MOST]:
        if _written_at(_path(run_folder, cell)) > newest:
            continue
        # The row states why; a missing recording does not fail a run.
        with suppress(SysidBenchError):
            written.append(_write(run_folder, cell, stored[cell], robots_dir))
    return written


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
    return open_viewer(path, web)


def _matching(run_folder: RunFolder, expression: str) -> list[str]:
    condition = Expression.parse(
        expression, run_folder.plan.fields | ROW_FIELDS | set(run_folder.suite.metrics)
    )
    stored = run_folder.rows().rows
    return [
        cell.id
        for cell in run_folder.plan.cells
        if cell.id in stored and condition.matches({**stored[cell.id], **fields(cell)})
    ]


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


def _write(
    run_folder: RunFolder, cell: str, row: Mapping[str, Any], robots_dir: Path | None
) -> Path:
    rule = run_folder.suite.record
    max_hz = rule.max_hz if rule else MAX_HZ
    # A recording needs the signals, which rows do not hold: the cell is executed again.
    (planned,) = [c for c in run_folder.plan.cells if c.id == cell]
    job = job_of([planned], run_folder.suite, robots_dir or run_folder.suite.robots_dir)
    path = _path(run_folder, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_recording(cell_data(job, dict(row)), path, quantity(max_hz, "Hz"))
