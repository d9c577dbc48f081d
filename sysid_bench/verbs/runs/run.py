"""Runs: plan and execute."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sysid_bench import package_folders
from sysid_bench.commands.result import OMIT_NONE, Result
from sysid_bench.errors import UsageError
from sysid_bench.experiments.spec import ExperimentSpec
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.comparison.baseline import Baseline
from sysid_bench.harness.plan import Shard, cells_of_suite
from sysid_bench.harness.run import Rerun
from sysid_bench.harness.run import RunResult as Outcome
from sysid_bench.harness.run import run as execute
from sysid_bench.harness.run_time import run_time, stored_times
from sysid_bench.harness.stored_run import RunFolder, run_names
from sysid_bench.harness.suite.load_suite import code_note, load_suite, third_party_names
from sysid_bench.harness.suite.names import static_names
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.harness.worker_names import worker_names
from sysid_bench.input_files import is_folder
from sysid_bench.verbs.runs.claims import ClaimsResult, claims_of
from sysid_bench.verbs.runs.gate import GateResult, gate_run, known_baseline
from sysid_bench.verbs.runs.recordings import record_selection, recording_notes
from sysid_bench.verbs.runs.report import report, summary_tables
from sysid_bench.verbs.runs.status import count_text, reason_lines

INTERRUPTED = 130
"""Exit code of a run that was interrupted; the same call resumes it."""


@dataclass(frozen=True, eq=False, repr=False)
class PlanResult(Result):
    """Cells of a suite. The attributes `cells` (in the order of the suite) and `experiments` (in
    the order of their first cell) hold the specifications; as a mapping and in JSON they are
    counts. `excluded`: cells by reason; `seconds`: expected CPU time of the whole run on one
    worker, and where that comes from, `seconds_from`; `notes` on the selection. The attribute
    `code` names the third-party code that the suite runs ("")."""

    cells: tuple[Cell, ...]
    experiments: tuple[ExperimentSpec, ...]
    excluded: Mapping[str, int]
    seconds: float
    seconds_from: str
    notes: tuple[str, ...]
    code: str = ""

    def summary(self) -> str:
        """Counts, exclusions and notes."""
        lines = [
            f"{len(self.cells)} cells in {len(self.experiments)} experiments, "
            f"about {self.seconds:.0f} s of one core ({self.seconds_from})",
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
            "seconds_from": self.seconds_from,
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
    gate: GateResult | None = field(default=None, metadata=OMIT_NONE)
    claims: ClaimsResult | None = field(default=None, metadata=OMIT_NONE)

    def summary(self) -> str:
        """Tables of the run, counts, notes and the path of its report."""
        folder = self.folder.path
        if self.exit_code == INTERRUPTED:
            return f"Interrupted; the same command resumes the run. Rows are in {folder}."
        if not self.counts:
            notes = " ".join(self.notes)
            if self.exit_code == 0:  # a shard without cells
                return notes
            return f"No cell was selected; see 'sysid-bench plan'. {notes}".rstrip()
        counts = count_text(self.counts)
        lines = [
            *summary_tables(folder),
            *([] if self.claims is None else [self.claims.summary() + "\n"]),
            counts + (f", {self.open} open" if self.open else ""),
            *reason_lines(self.folder, {*self.counts} - {"ok"}),
            *self.notes,
            f"report: {folder / 'report.html'}",
            *([] if self.gate is None else [self.gate.summary()]),
        ]
        return "\n".join(lines)

    def _fields(self) -> dict[str, Any]:
        more = {"gate": self.gate, "claims": self.claims}
        own = {key: part.to_dict() for key, part in more.items() if part is not None}
        return super()._fields() | {"folder": str(self.folder.path)} | own


def plan(
    suite: str | Path,
    select: str | None = None,
    overrides: Mapping[str, str] | None = None,
    robots_dir: Path | None = None,
    *,
    no_code: bool = False,
    large: bool = False,
) -> PlanResult:
    """Return the cells of a suite with every name resolved; no cell runs.

    `select`: an expression of cells; `overrides`: {key: value} of the suite; `large` admits more
    than a million cells. Third-party plug-ins are imported and built in a process of their own, or
    under `no_code` not at all: only that their file defines them is checked then, and a note names
    them. Raises UsageError with all errors of the suite.
    """
    own = nullcontext(static_names(robots_dir)) if no_code else worker_names(robots_dir)
    with own as names:
        loaded = load_suite(package_folders.suite(str(suite)), names, overrides)
    whole = cells_of_suite(loaded, names, large=large)
    plugins = third_party_names(loaded)
    unseen = [f"{kind} {name}" for kind, name in plugins] if no_code else []
    selected = replace(whole, cells=whole.select(select))
    expected = run_time(selected.cells, stored_times(map(Path, run_names())))
    why = whole.unknown_values(select) if select and not selected.cells else ()
    return PlanResult(
        cells=selected.cells,
        experiments=selected.spec_list,
        excluded=whole.excluded,
        seconds=expected.seconds,
        seconds_from=expected.source,
        notes=(*whole.notes, *why, *_not_imported(unseen)),
        code="" if no_code else code_note(plugins),
    )


def _not_imported(plugins: Sequence[str]) -> list[str]:
    """Note on plug-ins of which only the source was looked at."""
    if not plugins:
        return []
    return [f"Not imported, so that their settings are not checked: {', '.join(plugins)}."]


def run(
    suite: str | Path, out: str | Path | None = None, jobs: int | None = None,
    select: str | None = None, limit: int | None = None, timeout: float | str | None = None,
    *, rerun: Rerun | None = None, fail_fast: bool = False, record: str | None = None,
    overrides: Mapping[str, str] | None = None, robots_dir: Path | None = None,
    on_event: OnEvent | None = None, shard: str | None = None, large: bool = False,
    baseline: str | Path | None = None, times: bool = False, gate: bool = False,
    executor: str = "local",
) -> RunResult:  # fmt: skip
    """Run a suite (or resume a run folder), then write its tables, figures, recordings and report.

    `jobs`: workers (default: one per core); `limit`: the first selected cells; `timeout` per
    cell; `rerun`: "failed", "stale" or "all"; `record`: an expression of cells to record instead of
    the suite's own choice; `shard`: "2/8", a part of the plan for one of several machines, whose
    runs `merge` joins; `large` admits more than a million cells; `baseline`: a file that the run is
    compared with (the selected cells alone), `times` included; `gate`: the exit code is 1 unless
    all claims with `gate = true` hold; `executor`: where cells are computed ("dask://HOST:PORT",
    "slurm:FILE" or a plug-in). Raises UsageError before anything runs.
    """
    known = _baseline(baseline, times=times)
    outcome = execute(
        Path(suite) if is_folder(Path(suite)) else str(suite),
        None if out is None else Path(out),
        shard=None if shard is None else Shard.parse(shard),
        jobs=jobs, select=select, limit=limit, timeout=timeout, rerun=rerun, fail_fast=fail_fast,
        on_event=on_event, robots_dir=robots_dir, overrides=overrides, large=large,
        executor=executor,
    )  # fmt: skip
    result = _run_result(outcome, _write_reports(outcome, record, robots_dir), gate)
    if known is None or not _is_complete(outcome):
        return result
    part = bool(select or limit or shard)
    compared = gate_run(result.folder, known, str(baseline), partial=part, times=times)
    return replace(result, gate=compared, exit_code=result.exit_code or int(not compared.ok))


def _baseline(file: str | Path | None, *, times: bool) -> Baseline | None:
    if times and file is None:
        raise UsageError("--times compares with a baseline; name it with --baseline FILE.")
    return None if file is None else known_baseline(file, times=times)


def _is_complete(outcome: Outcome) -> bool:
    """True for a run that has rows and was not interrupted."""
    return bool(outcome.counts) and outcome.exit_code != INTERRUPTED


def _write_reports(
    outcome: Outcome, record: str | None, robots_dir: Path | None
) -> tuple[str, ...]:
    """Write recordings and report of a complete run; return notes."""
    if not _is_complete(outcome):
        return ()
    record_selection(outcome.folder, record, robots_dir)
    report(outcome.folder.path)
    return recording_notes(outcome.folder)


def _run_result(outcome: Outcome, more: Sequence[str], gate: bool) -> RunResult:
    tested = claims_of(outcome.folder) if _is_complete(outcome) else None
    fails = gate and tested is not None and not tested.ok
    return RunResult(
        folder=outcome.folder,
        counts=outcome.counts,
        open=outcome.open,
        asked=outcome.asked,
        exit_code=outcome.exit_code or int(fails),
        notes=(*outcome.notes, *more),
        claims=tested,
    )
