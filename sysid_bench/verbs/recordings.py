"""Recordings: execute a cell again and write it for the Rerun viewer."""

import subprocess
from collections.abc import Iterable, Mapping
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
    if all(c in "0123456789abcdef" for c in what):
        chosen = [find_cell(run_folder, what)]
    else:
        chosen = _matching(run_folder, what)
    if not chosen:
        raise UsageError(f"No finished cell of {str(folder)!r} meets {what!r}; nothing to record.")
    max_hz = run_folder.suite.record.max_hz if run_folder.suite.record else MAX_HZ
    for cell in chosen:
        if cell not in stored:
            raise UsageError(f"The cell {cell} has not run yet; run it first, then record it.")
        if stored[cell].get("status") in ("crash", "timeout"):
            raise UsageError(
                f"The cell {cell} ended as {stored[cell]['status']}; executed again here it would "
                "take this command with it. Record another cell of its experiment."
            )
    return [_write(run_folder, cell, stored[cell], max_hz, robots_dir) for cell in chosen]


def record_selected(
    run_folder: RunFolder, expression: str | None = None, robots_dir: Path | None = None
) -> list[Path]:
    """Write the recordings that a suite's [record] (or `expression`) selects, at most `MOST`, where
    they are absent or old. Cells without data (skipped, crash, timeout) are left out."""
    rule = run_folder.suite.record
    chosen = list(_matching(run_folder, expression)) if expression else list(_by_rule(run_folder))
    stored = run_folder.rows().rows
    written = []
    newest = max(
        (f.stat().st_mtime for f in (run_folder.path / "cells").glob("*.jsonl")), default=0
    )
    for cell in [c for c in dict.fromkeys(chosen) if stored[c].get("data_rank") is not None][:MOST]:
        path = _path(run_folder, cell)
        if path.is_file() and path.stat().st_mtime > newest:
            continue
        try:
            max_hz = rule.max_hz if rule else MAX_HZ
            written.append(_write(run_folder, cell, stored[cell], max_hz, robots_dir))
        except SysidBenchError:
            continue  # the row states why; a missing recording does not fail a run
    return written


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
    groups = (
        [measured] if per is None else [group for _, group in measured.groupby(per, sort=False)]
    )
    for group in groups:
        yield from group["id"].head(count)


def _path(run_folder: RunFolder, cell: str) -> Path:
    return run_folder.path / "artifacts" / cell / "recording.rrd"


def _write(
    run_folder: RunFolder, cell: str, row: Mapping[str, Any], max_hz: Any, robots_dir: Path | None
) -> Path:
    (planned,) = [c for c in run_folder.plan.cells if c.id == cell]
    job = job_of([planned], run_folder.suite, robots_dir or run_folder.suite.robots_dir)
    path = _path(run_folder, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_recording(cell_data(job, dict(row)), path, quantity(max_hz, "Hz"))
