"""Runs: plan, execute, inspect, reproduce."""

import json
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sysid_bench import places
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.harness.plan import Cell, expand
from sysid_bench.harness.run import Rerun
from sysid_bench.harness.run import RunResult as Outcome
from sysid_bench.harness.run import run as execute
from sysid_bench.harness.store import RunFolder
from sysid_bench.harness.suite.load_suite import load_suite
from sysid_bench.harness.suite.names import installed_names
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.verbs.folders import find_cell, open_run
from sysid_bench.verbs.recordings import record_selected
from sysid_bench.verbs.report import printed_tables, report
from sysid_bench.verbs.result import Result

INTERRUPTED = 130
"""Exit code of a run that was interrupted; the same call resumes it."""


@dataclass(frozen=True, eq=False, repr=False)
class PlanResult(Result):
    """Cells of a suite. The attributes `cells` (in the order of the suite) and `experiments` (in
    the order of their first cell) hold the specifications; as a mapping and in JSON they are
    counts. `excluded`: cells by reason; `seconds`: expected cost on one worker; `notes` on the
    selection."""

    cells: tuple[Cell, ...]
    experiments: tuple[ExperimentSpec, ...]
    excluded: Mapping[str, int]
    seconds: float
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Counts, exclusions and notes."""
        lines = [
            f"{len(self.cells)} cells in {len(self.experiments)} experiments, "
            f"about {self.seconds:.0f} s of one core",
            *(f"{count} cells excluded: {reason}" for reason, count in self.excluded.items()),
            *self.notes,
        ]
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        return {
            "cells": len(self.cells),
            "experiments": len(self.experiments),
            "excluded": dict(self.excluded),
            "seconds": self.seconds,
            "errors": [],
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False, repr=False)
class RunResult(Result):
    """Outcome of the selected cells: `counts` by status, `open` without a row, `asked` to run."""

    folder: RunFolder
    counts: Mapping[str, int]
    open: int
    asked: int
    exit_code: int
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Tables of the run, counts, notes and the path of its report."""
        folder = self.folder.path
        if self.exit_code == INTERRUPTED:
            return f"Interrupted; the same command resumes the run. Rows are in {folder}."
        if not self.counts:
            notes = " ".join(self.notes)
            return f"No cell was selected; see 'sysid-bench plan'. {notes}".rstrip()
        counts = _counts_text(self.counts)
        lines = [
            *printed_tables(folder),
            counts + (f", {self.open} open" if self.open else ""),
            *self.notes,
            f"report: {folder / 'report.html'}",
        ]
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        return super()._fields() | {"folder": str(self.folder.path)}


def _counts_text(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {status}" for status, count in counts.items())


@dataclass(frozen=True, eq=False, repr=False)
class StatusResult(Result):
    """Progress of a run: planned cells, rows by status, and reasons with their counts."""

    folder: str
    cells: int
    open: int
    statuses: dict[str, int]
    reasons: list[dict[str, Any]]

    def summary(self) -> str:
        """Counts, then one line for each reason."""
        counts = _counts_text(self.statuses) or "no rows"
        lines = [f"{self.cells} cells: {counts}, {self.open} open"]
        lines += [f"  {r['cells']} {r['status']}: {r['reason']}" for r in self.reasons]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False, repr=False)
class CellResult(Result):
    """Row of a cell with its fields as keys; `command` reproduces it."""

    row: Mapping[str, Any]
    command: str

    def summary(self) -> str:
        """One line per field, then the traceback of a failure."""
        tables = ("joints", "parameters_table", "traceback")
        fields = {key: value for key, value in self.items() if key not in tables}
        lines = [f"{key:<22} {_json_text(value)}" for key, value in fields.items()]
        traceback = self.row.get("traceback")
        return "\n".join([*lines, f"\n{traceback}"] if traceback else lines)

    def _fields(self) -> dict[str, Any]:
        return {**self.row, "command": self.command}


def _json_text(value: Any) -> str:
    """JSON of a field; a string without quotes."""
    return value if isinstance(value, str) else json.dumps(value)


def plan(
    suite: str | Path,
    select: str | None = None,
    overrides: Mapping[str, str] | None = None,
    robots_dir: Path | None = None,
) -> PlanResult:
    """Return the cells of a suite with every name resolved; nothing runs.

    `select`: an expression of cells; `overrides`: {key: value} of the suite. Raises UsageError with
    all errors of the suite.
    """
    names = installed_names(robots_dir)
    whole = expand(load_suite(places.suite(str(suite)), names, overrides), names)
    selected = replace(whole, cells=whole.select(select))
    why = whole.missing_values(select) if select and not selected.cells else ()
    return PlanResult(
        cells=selected.cells,
        experiments=selected.experiments,
        excluded=whole.excluded,
        seconds=selected.seconds,
        notes=(*whole.notes, *why),
    )


def run(
    suite: str | Path,
    out: str | Path | None = None,
    jobs: int | None = None,
    select: str | None = None,
    limit: int | None = None,
    timeout: float | str | None = None,
    *,
    rerun: Rerun | None = None,
    fail_fast: bool = False,
    record: str | None = None,
    overrides: Mapping[str, str] | None = None,
    robots_dir: Path | None = None,
    on_event: OnEvent | None = None,
) -> RunResult:
    """Run a suite (or resume a run folder), then write its tables, figures, recordings and report.

    `jobs`: workers (default: one per core); `limit`: the first selected cells; `timeout` per
    experiment; `rerun`: "failed", "stale" or "all"; `record`: an expression of cells to record
    instead of the suite's own choice. Raises UsageError before anything runs.
    """
    outcome = execute(
        Path(suite) if Path(suite).is_dir() else str(suite),
        None if out is None else Path(out),
        jobs=jobs,
        select=select,
        limit=limit,
        timeout=timeout,
        rerun=rerun,
        fail_fast=fail_fast,
        on_event=on_event,
        robots_dir=robots_dir,
        overrides=overrides,
    )
    _write_reports(outcome, record, robots_dir)
    return _run_result(outcome)


def _write_reports(outcome: Outcome, record: str | None, robots_dir: Path | None) -> None:
    """Write recordings and report of a run that has rows and was not interrupted."""
    if outcome.counts and outcome.exit_code != INTERRUPTED:
        record_selected(outcome.folder, record, robots_dir)
        report(outcome.folder.path)


def _run_result(outcome: Outcome) -> RunResult:
    return RunResult(
        folder=outcome.folder,
        counts=outcome.counts,
        open=outcome.open,
        asked=outcome.asked,
        exit_code=outcome.exit_code,
        notes=outcome.notes,
    )


def status(folder: str | Path) -> StatusResult:
    """Return the progress of a run and the reasons of cells that are not `ok`."""
    run_folder = open_run(folder)
    stored, planned = run_folder.heads().rows, run_folder.planned
    rows = [stored[cell] for cell in planned if cell in stored]
    return StatusResult(
        folder=str(run_folder.path),
        cells=len(planned),
        open=len(planned) - len(rows),
        statuses=dict(Counter(row["status"] for row in rows)),
        reasons=_reasons(rows),
    )


def _reasons(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Reasons of the cells that are not ok, the most frequent first."""
    pairs = ((row["status"], row.get("reason") or "") for row in rows if row["status"] != "ok")
    return [
        {"status": status, "reason": reason, "cells": count}
        for (status, reason), count in Counter(pairs).most_common()
    ]


def cell(folder: str | Path, identifier: str) -> CellResult:
    """Return the row of a cell, by a unique beginning of its id, and the command that reproduces
    it. Raises UsageError where none or several cells begin with it."""
    run_folder = open_run(folder)
    full = find_cell(run_folder, identifier)
    missing = {"id": full, "status": "open", "reason": "has not run yet"}
    path = shlex.quote(str(run_folder.path))
    return CellResult(
        row=run_folder.row(full) or missing,
        command=f"sysid-bench run {path} --select 'id == \"{full}\"' --rerun all",
    )
