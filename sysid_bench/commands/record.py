"""Verbs `record` and `view`: cells executed again and written for the Rerun viewer.

Cells with third-party code are executed in a worker process, as in a run: what goes wrong there
costs the one recording, and its reason is kept in its place.
"""

import shlex
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.request import OK, Request, argument, option, python_function
from sysid_bench.errors import UsageError, reason_of
from sysid_bench.extras import extra_module
from sysid_bench.input_files import read_text
from sysid_bench.units import quantity

if TYPE_CHECKING:
    from sysid_bench.experiments.job_channel import JobChannel
    from sysid_bench.harness.stored_run import RunFolder

MOST: Final = 20
"""Recordings that a run writes by itself; `record` writes more."""
MAX_HZ: Final = 50.0
"""Default sampling rate of recordings."""
_REASON: Final = "no_recording.txt"
_LONGEST_NOTE: Final = 100_000  # bytes
_ENDED: Final = ("crash", "timeout", "memory")
"""Statuses of cells that ended their process."""


class Record(Request[list[Path]]):
    """Execute a cell again and write its recording for the Rerun viewer."""

    has_json = False

    folder: str | Path = argument("RUN", complete="runs folders")
    what: str = argument("ID|SPEC", complete="cells")
    robots_dir: Path | None = None

    def run(self) -> list[Path]:
        """Write recordings of the cell with the id `what`, or of all that meet the expression
        `what`; return their paths. `robots_dir`: that of the run where it is elsewhere now. Raises
        UsageError for cells that have not run or that ended their process, and, when all others are
        written, for those that cannot be recorded.
        """
        from sysid_bench.commands.run_folder import find_cell, open_run

        run = open_run(self.folder)
        is_id = set(self.what) <= set("0123456789abcdef")  # an expression has other letters
        chosen = [find_cell(run, self.what)] if is_id else matching_cells(run, self.what)
        if not chosen:
            raise UsageError(
                f"No finished cell of {str(self.folder)!r} meets {self.what!r}; nothing to record."
            )
        stored = run.rows(frozenset(chosen)).rows
        for cell in chosen:
            status = stored[cell].get("status") if cell in stored else None
            if cell not in stored:
                raise UsageError(f"The cell {cell} has not run yet; run it first, then record it.")
            if status in _ENDED:
                raise UsageError(
                    f"The cell {cell} ended as {status}; executed again it would end the same way, "
                    "without a recording. Record another cell of its experiment."
                )
        attempts = [_attempt(run, cell, stored[cell], self.robots_dir) for cell in chosen]
        # After all attempts: one recording that fails does not cost the others.
        failures = [*filter(None, attempts)]
        written = len(attempts) - len(failures)
        if failures:
            raise UsageError("\n".join([*failures, *([f"{written} written."] if written else [])]))
        return [_path(run, cell) for cell in chosen]

    def shell(self, as_json: bool) -> int:
        for path in self.run():
            click.echo(str(path))
            hint = f"sysid-bench view {shlex.quote(str(self.folder))} {path.parent.name}"
            click.echo(f"look at it: {hint}", err=True)  # stdout holds paths alone
        return OK


class View(Request["subprocess.Popen[bytes]"]):
    """Open the recording of a cell."""

    has_json = False

    folder: str | Path = argument("RUN", complete="runs folders")
    identifier: str = argument("ID", complete="cells")
    web: bool = option("Open it in the browser, served on this machine alone.", default=False)

    def run(self) -> "subprocess.Popen[bytes]":
        """Open the recording of a cell, written first where it is absent."""
        from sysid_bench.commands.run_folder import find_cell, open_run
        from sysid_bench.reporting import view as viewer

        run = open_run(self.folder)
        cell = find_cell(run, self.identifier)
        path = _path(run, cell)
        if not path.is_file():
            (path,) = record(self.folder, cell)
        return viewer.view(path, self.web)

    def shell(self, as_json: bool) -> int:
        return int(self.run().wait())


record = python_function(Record, "record")
view = python_function(View, "view")


# --- Recordings of a run ------------------------------------------------------------------------


def record_selection(
    run: "RunFolder", expression: str | None = None, robots_dir: Path | None = None
) -> None:
    """Write the recordings that a suite's [record] (or `expression`) selects, at most `MOST`, where
    they are absent or old. Cells without data (skipped, crash, timeout) are left out."""
    chosen = list(matching_cells(run, expression) if expression else _by_rule(run))
    if not chosen:
        return
    stored = run.rows(frozenset(chosen)).rows
    with_data = [c for c in dict.fromkeys(chosen) if stored[c].get("data_rank") is not None]
    # Any row may be of this cell: without reading them all, the newest file decides.
    newest_row = max(map(_written_at, (run.path / "cells").glob("*.jsonl")), default=0.0)
    for cell in with_data[:MOST]:
        path = _path(run, cell)
        # A reason stands for the recording that could not be written: it is not tried again.
        if max(_written_at(path), _written_at(path.with_name(_REASON))) <= newest_row:
            _attempt(run, cell, stored[cell], robots_dir)


def recording_notes(run: "RunFolder") -> tuple[str, ...]:
    """Return the reasons of the recordings that could not be written."""
    notes = []
    for file in sorted((run.path / "artifacts").glob(f"*/{_REASON}")):
        try:
            notes.append(read_text(file, largest=_LONGEST_NOTE).strip())
        except (OSError, UnicodeDecodeError) as error:
            notes.append(f"{file.parent.name}: its note cannot be read ({error}).")
    return tuple(notes)


def matching_cells(run: "RunFolder", expression: str) -> list[str]:
    """Return the ids of the cells whose row meets an expression, in the order of the plan."""
    from sysid_bench.commands.run_folder import rows_with
    from sysid_bench.harness.suite.expression import Expression
    from sysid_bench.metrics import ROW_FIELDS

    known = run.plan.fields | ROW_FIELDS | set(run.suite.metrics)
    met = rows_with(run, Expression.parse(expression, known))
    return [cell for cell in run.planned if met.get(cell)]


def _by_rule(run: "RunFolder") -> Iterator[str]:
    """Ids that the suite's [record] selects: the worst, then those that meet its expression."""
    rule = run.suite.record
    worst = None if rule is None else rule.worst
    rows = None if worst is None else run.frames().cells
    if worst is not None and rows is not None and worst.metric in rows:
        measured = rows[rows[worst.metric].notna()]
        measured = measured.sort_values(worst.metric, ascending=False, kind="stable")
        # Cells of one group stand together, in the order in which the groups first occur.
        groups = [measured]
        if worst.per is not None:
            groups = [group for _, group in measured.groupby(worst.per, sort=False)]
        for group in groups:
            yield from group["id"].head(worst.count)
    if rule is not None and rule.when is not None:
        yield from matching_cells(run, rule.when)


def _path(run: "RunFolder", cell: str) -> Path:
    return run.path / "artifacts" / cell / "recording.rrd"


def _written_at(file: Path) -> float:
    """Time (s since the epoch) when a file was last written; -1 for an absent one."""
    return file.stat().st_mtime if file.is_file() else -1.0


def _attempt(run: "RunFolder", cell: str, row: Mapping[str, Any], robots_dir: Path | None) -> str:
    """Write the recording of a cell, or the reason why it cannot be; return the reason, else ""."""
    from sysid_bench.harness.work.worker_call import WorkerError

    path = _path(run, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    reason = ""
    try:
        _write(run, cell, row, robots_dir)
    except WorkerError as error:
        reason = str(error)
    except Exception as error:  # a missing recording does not fail a run
        reason = f"The recording of {cell} could not be written: {reason_of(error)}"
    if reason:
        path.with_name(_REASON).write_text(f"{reason}\n", encoding="utf-8")
        for old in path.parent.glob(f"{path.name}*"):  # of an older row, or unfinished
            old.unlink()
    else:
        path.with_name(_REASON).unlink(missing_ok=True)
    return reason


def _write(run: "RunFolder", cell: str, row: Mapping[str, Any], robots_dir: Path | None) -> None:
    from sysid_bench.harness.run import job_of
    from sysid_bench.harness.work.worker_call import worker_call

    # A recording needs the signals, which rows do not hold: the cell is executed again.
    (planned,) = [c for c in run.plan.cells if c.id == cell]
    job = job_of([planned], run.suite, robots_dir or run.suite.robots_folder)
    rule = run.suite.record
    call = {
        "job": job,
        "row": dict(row),
        "path": str(_path(run, cell).resolve()),
        "max_hz": quantity(rule.max_hz if rule else MAX_HZ, "Hz"),
    }
    if any(job["third_party"].values()):
        limits = run.suite.run
        title = f"The recording of {cell} ({row.get('estimator')}) could not be written"
        timeout, memory = quantity(limits.timeout, "s"), quantity(limits.memory, "B")
        worker_call(f"{__name__}:write_cell", call, title, timeout, memory)
    else:
        write_cell(call)


def write_cell(argument: Mapping[str, Any], channel: "JobChannel | None" = None) -> None:
    """Execute a cell and write its recording, here or in a worker process."""
    from sysid_bench.experiments.cell_data import cell_data

    extra_module("rerun", "A recording", "Rows, tables and report need none.")
    from sysid_bench.reporting import recording

    data = cell_data(argument["job"], argument["row"])
    recording.record(data, Path(argument["path"]), argument["max_hz"])
