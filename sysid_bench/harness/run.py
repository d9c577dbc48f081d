"""Run a suite, or continue a run: only cells without a row are executed.

Exit codes, the first that applies: 130 interrupted; 5 the machines of the executor are gone; 0
other shards have all selected cells; 4 no cell was selected; 3 a selected cell is failed, timeout,
crash, memory or lost; 1 a robot's cross-check failed; 4 no row is ok; 0. Codes 3 and 1 precede the
second 4 because they give its reason.
"""

import os
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any, Final, Literal

from sysid_bench import package_folders
from sysid_bench.errors import FAILURES, UsageError, unknown_name
from sysid_bench.experiments.spec import SEEDS
from sysid_bench.experiments.third_party import third_party_parts
from sysid_bench.harness.cell import Cell, PlannedRow, fields
from sysid_bench.harness.executor import Executor, RunEnd, Work, executor_of
from sysid_bench.harness.fingerprint import current_fingerprint, is_stale, stale_note
from sysid_bench.harness.plan import Plan, Shard, cells_of_suite
from sysid_bench.harness.stored_run import RunFolder, frames_of_run
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.load_suite import code_note, load_suite, third_party_names
from sysid_bench.harness.suite.model import Origin, Suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.work.confinement import wanted_isolation
from sysid_bench.harness.work.row_files import ROWS_DIGEST, rows_digest
from sysid_bench.harness.work.supervise import Ending, OnEvent, no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.harness.worker_names import worker_names
from sysid_bench.input_files import is_folder
from sysid_bench.models.behaviour_change import behaviour_changes
from sysid_bench.models.model_record import model_record
from sysid_bench.plugin_names import resolve_files
from sysid_bench.types import Row
from sysid_bench.units import quantity
from sysid_bench.version_fields import environment
from sysid_bench.words import MOST_LOSSES, STATUSES

Rerun = Literal["failed", "stale", "all"]
EXECUTE: Final = "sysid_bench.experiments.execute:execute"
_RERUNS: Final = ("failed", "stale", "all")
_CODES: Final[Mapping[Ending, int]] = {"interrupted": 130, "lost": 5}


@dataclass(frozen=True)
class RunResult:
    """Outcome of the selected cells: `counts` by status, `open` cells without a row, `asked` cells
    that this call had to run."""

    folder: RunFolder
    counts: Mapping[str, int]
    open: int
    asked: int
    exit_code: int
    notes: tuple[str, ...] = ()


def run(
    suite_or_folder: Suite | str | Path,
    out: Path | None = None,
    *,
    jobs: int | None = None,
    select: str | None = None,
    limit: int | None = None,
    shard: Shard | None = None,
    timeout: float | str | None = None,
    rerun: Rerun | None = None,
    fail_fast: bool = False,
    on_event: OnEvent | None = None,
    call: str = EXECUTE,
    names: Names | None = None,
    robots_dir: Path | None = None,
    overrides: Mapping[str, str] | None = None,
    large: bool = False,
    executor: str = "local",
) -> RunResult:
    """Execute the selected cells that have no row; a run folder holds its own suite.

    `limit` takes the first selected cells in the order of the plan, with a row or without, `shard`
    a part of the plan for one of several machines (see harness/merge.py);
    `timeout` (s) and `jobs` (default: the cores) change no cell; `large` admits more than a million
    cells; `executor` names what computes them (see harness/executor.py). `on_event` gets
    ("code", {note}) where third-party code will run, ("plan", {cells, open, tasks, seconds}), then
    the events of the executor. Raises UsageError before any run.
    """
    # Checked before suites and models are read, which may take seconds.
    request = _Request(
        select, limit, shard, timeout=timeout, rerun=rerun, jobs=jobs, fail_fast=fail_fast,
        call=call, robots_dir=robots_dir,
    )  # fmt: skip
    on_event = on_event or no_progress
    wanted_isolation()
    # An executor that is not there is an error before the suite is read.
    chosen = executor_of(executor)
    source, overrides = suite_or_folder, overrides or {}
    if not isinstance(source, Suite) and is_folder(Path(source)):
        # A run that is named goes on with its frozen suite, whatever its file says today.
        folder = _open_run(Path(source), out, overrides)
        if os.environ.get(SEEDS):  # a maintainer runs the sealed cells of a submission
            folder.check_path()
    else:
        with nullcontext(names) if names else worker_names(robots_dir) as known:
            suite = source
            if not isinstance(suite, Suite):
                suite = _load(str(source), known, overrides, request)
            plan = cells_of_suite(suite, known, large=large)
        if select is not None:
            Expression.parse(select, plan.fields)  # an unknown field leaves no folder behind
        folder = RunFolder.new(out or Path("reports") / suite.name, suite, plan, environment())
    if note := code_note(third_party_names(folder.suite, robots_dir)):
        on_event("code", {"note": note})  # before any of it runs in a cell
    return _run_selected(request, folder, chosen, on_event)


@dataclass(frozen=True)
class _Request:
    """Request of a call of `run` besides its suite: cells, those to repeat, and limits."""

    select: str | None
    limit: int | None
    shard: Shard | None
    timeout: float | str | None
    rerun: Rerun | None
    jobs: int | None
    fail_fast: bool
    call: str
    robots_dir: Path | None

    def __post_init__(self) -> None:
        if self.timeout is not None:
            _seconds(self.timeout)
        if self.rerun is not None and self.rerun not in _RERUNS:
            raise unknown_name("way to rerun", self.rerun, _RERUNS)
        for word, number in (("limit", self.limit), ("jobs", self.jobs)):
            if number is not None and number < 1:
                raise UsageError(f"{word} is {number}; give 1 or more, or leave it out.")

    def selected(self, plan: Plan) -> tuple[Cell, ...]:
        """Cells that are chosen."""
        cells = plan.select(self.select)
        if self.shard is not None:
            own = self.shard.experiments(plan.cells)
            cells = tuple(cell for cell in cells if cell.experiment in own)
        return cells[: self.limit]

    def open_cells(
        self, cells: Iterable[Cell], stored: Mapping[str, Row], fingerprint: Callable[[Cell], str]
    ) -> list[Cell]:
        """Return the cells that have to run: without a row, or repeated."""
        return [
            cell
            for cell in cells
            if cell.id not in stored or self.is_repeated(cell, stored[cell.id], fingerprint)
        ]

    def is_repeated(self, cell: Cell, row: Row, fingerprint: Callable[[Cell], str]) -> bool:
        """True for a cell that has to run though it has a row."""
        if self.rerun == "all":
            return True
        # The machine failed and not the method: again without being asked, but not for ever.
        if row.get("status") == "lost" and row.get("losses", 1) < MOST_LOSSES:
            return True
        if self.rerun == "failed":
            return row.get("status") not in ("ok", "unsupported")
        return self.rerun == "stale" and is_stale(row, fingerprint(cell))


def _seconds(timeout: float | str) -> float:
    seconds = quantity(timeout, "s")
    if seconds <= 0:
        raise UsageError(f"The timeout is {timeout!r}; give a positive time, as '60 s'.")
    return seconds


def _open_run(path: Path, out: Path | None, overrides: Mapping[str, str]) -> RunFolder:
    """Open a run folder; raise UsageError for options that only a suite takes."""
    if out is not None and out.resolve() != path.resolve():
        raise UsageError(
            f"{str(path)!r} is a run itself; it continues in its own folder, without -o."
        )
    if overrides:
        raise UsageError(f"{str(path)!r} is a run: its suite is frozen; --set needs a suite.")
    return RunFolder.open(path)


def _load(source: str, names: Names, overrides: Mapping[str, str], request: "_Request") -> Suite:
    """Return the suite that `source` names, with the command line as its origin."""
    suite, robots = load_suite(package_folders.suite(source), names, overrides), request.robots_dir
    words = ["sysid-bench", "run", source]
    words += ["--robots", str(robots)] if robots else []
    words += [word for key, value in overrides.items() for word in ("--set", f"{key}={value}")]
    chosen = {"--select": request.select, "--limit": request.limit, "--shard": request.shard}
    pairs = [(word, str(value)) for word, value in chosen.items() if value is not None]
    origin = Origin(
        folder=str(suite.folder),
        robots=str(robots.resolve()) if robots else None,
        command=shlex.join(words),
        selection=tuple(chain.from_iterable(pairs)),
    )
    return suite.model_copy(update={"origin": origin})


def _run_selected(
    request: _Request, folder: RunFolder, executor: Executor, on_event: OnEvent
) -> RunResult:
    """Compute the selected cells that have to run, and write the frames of the run."""
    selected = request.selected(folder.plan)
    robots_dir = request.robots_dir or folder.suite.robots_folder
    fingerprint = current_fingerprint(folder.suite, robots_dir)
    with folder.lock() as lock:
        # Read under the lock, which orphans of a killed run hold: nobody adds a row from here on.
        stored = folder.first_fields().rows
        todo = request.open_cells(selected, stored, fingerprint)
        _check_models(folder, todo, robots_dir)
        rows = (
            PlannedRow(cell, fingerprint(cell), stored.get(cell.id, {}).get("losses") or 0)
            for cell in todo
        )
        work = _work(request, folder, rows, lock)
        # Expected seconds by cell are the weights of a progress bar.
        counts = {"cells": len(selected), "open": len(work.seconds), "tasks": len(work.jobs)}
        on_event("plan", {**counts, "seconds": work.seconds})
        ended = _compute(work, folder, executor, on_event)
        del work  # the jobs of a million cells: consolidation needs the memory
        folder.write_frames()
        kept = {cell.id for cell in selected}.difference(cell.id for cell in todo)
        stale = sum(is_stale(stored[c.id], fingerprint(c)) for c in selected if c.id in kept)
    notes = [stale_note(stale)] if stale else []
    if request.select and not selected:
        notes += folder.plan.unknown_values(request.select)
    notes += ended.notes
    result = _result(folder, selected, len(todo), ended.ending, notes)
    if request.shard is not None and not selected and folder.plan.select(request.select):
        empty = f"Shard {request.shard} has no cell: other shards have them all."
        return replace(result, exit_code=0, notes=(*result.notes, empty))
    return result


def _check_models(folder: RunFolder, todo: Iterable[Cell], robots_dir: Path | None) -> None:
    """Raise UsageError for a robot that is another one than when the run was planned: the ids of
    its cells, and so its rows, are of that one."""
    robots = {cell.labels["robot"]: cell.spec for cell in todo}
    for label, planned in folder.models.items():
        if (spec := robots.get(label)) is None:
            continue
        now = model_record(spec.robot, robots_dir, folder.suite.folder, spec.free_base)
        if now is not None and now["hash"] != planned["hash"]:
            changes = behaviour_changes(label, planned["behaviour"], now["behaviour"])
            what = f" ({changes[0].joint or 'robot'}: {changes[0].quantity})" if changes else ""
            raise UsageError(
                f"The robot {label!r} is another one than when {str(folder.path)!r} was "
                f"planned{what}; run the suite into another folder (-o)."
            )


def _work(
    request: _Request, folder: RunFolder, rows: Iterable[PlannedRow], lock: int | None
) -> Work:
    """Return the jobs of some cells, one for each experiment, whose cells share its data."""
    suite, robots_dir = folder.suite, request.robots_dir or folder.suite.robots_folder
    groups: dict[str, list[PlannedRow]] = {}
    for row in rows:
        groups.setdefault(row.cell.experiment, []).append(row)

    def job(heads: Sequence[PlannedRow]) -> Job:
        cells = [row.cell for row in heads]
        argument = job_of(cells, suite, robots_dir) | {
            "fingerprints": {row.cell.id: row.fingerprint for row in heads},
            "artifacts": str(folder.path.resolve() / "artifacts"),
        }
        # A worker keeps models of a robot with its payload in memory from job to job.
        group = " ".join(cells[0].labels[key] for key in ("robot", "payload"))
        return Job(request.call, argument, tuple(heads), group)

    limits = suite.run
    return Work(
        jobs=list(map(job, groups.values())),
        settings=WorkerSettings(
            folder=folder.path,
            timeout=_seconds(limits.timeout if request.timeout is None else request.timeout),
            threads=limits.threads,
            keep_open=() if lock is None else (lock,),
            memory=quantity(limits.memory, "B"),
        ),
        seconds={row.cell.id: row.cell.seconds for heads in groups.values() for row in heads},
        folders=tuple(place.resolve() for place in (suite.folder, robots_dir) if place is not None),
        workers=request.jobs or os.cpu_count() or 1,
        fail_fast=request.fail_fast,
    )


def job_of(cells: Sequence[Cell], suite: Suite, robots_dir: Path | None) -> dict[str, Any]:
    """Return the argument for these cells, all of one experiment.

    Plug-in files and robots are found from the suite's folder; `labels` begin every row.
    """
    argument: dict[str, Any] = {
        "experiment": cells[0].spec.to_json(),
        "seed": suite.seed,
        "estimators": [
            {
                **resolve_files(cell.estimator, suite.folder),
                "cell": cell.id,
                "label": cell.labels["estimator"],
            }
            for cell in cells
        ],
        "metrics": [
            {"name": entry.metric.name, "spec": resolve_files(entry.spec, suite.folder)}
            for entry in suite.metric
        ],
        "papers": _papers_of(cells, suite),
        "labels": {k: v for k, v in cells[0].first_fields.items() if k not in ("id", "estimator")},
        "crosscheck": {
            "tolerance": quantity(suite.crosscheck.tolerance, "1"),
            "on_fail": suite.crosscheck.on_fail,
        },
        "folder": str(suite.folder),
        "robots_dir": None if robots_dir is None else str(robots_dir.resolve()),
    }
    return argument | {"third_party": third_party_parts(argument)}


def _papers_of(cells: Sequence[Cell], suite: Suite) -> dict[str, list[dict[str, Any]]]:
    """Return the papers that may show a cell, by its id."""
    papers: dict[str, list[dict[str, Any]]] = {cell.id: [] for cell in cells if suite.paper}
    for entry, cell in product(suite.paper, cells):
        flat, condition = fields(cell), entry.select and Expression.parse(entry.select)
        # A condition on scores is open until the cell has run.
        if not condition or not condition.fields <= set(flat) or condition.holds(flat):
            shown = {"name": entry.name, "show": entry.show, "test": entry.test}
            papers[cell.id].append(shown)
    return papers


def _compute(work: Work, folder: RunFolder, executor: Executor, on_event: OnEvent) -> RunEnd:
    """Let the executor do the work, if there is any, while the run is consolidated; env.json
    describes this machine, and those elsewhere that compute."""
    found = environment()
    if work.jobs:
        folder.write_environment(found)
    with frames_of_run(folder, work.settings.keep_open, on_event) as heard:

        def hear(kind: str, data: Mapping[str, Any]) -> None:
            if kind != "machine":
                heard(kind, data)
                return
            found["machines"] = {**found.get("machines", {}), data["id"]: dict(data)}
            folder.write_environment(found)

        ended = executor.work(work, hear) if work.jobs else RunEnd("finished")
    if work.jobs:
        # Published with a submission, it holds the rows to what they were.
        found[ROWS_DIGEST] = rows_digest(folder.path / "cells")
        folder.write_environment(found)
    return ended


def _result(
    folder: RunFolder, selected: Sequence[Cell], asked: int, ending: Ending, more: Iterable[str]
) -> RunResult:
    stored = folder.first_fields()
    rows = [stored.rows[cell.id] for cell in selected if cell.id in stored.rows]
    number = Counter(str(row.get("status")) for row in rows)
    notes = []
    if stored.torn:
        notes.append(
            f"{stored.torn} unfinished rows of killed writers were skipped; their cells ran again."
        )
    if stored.garbled:
        notes.append(
            f"{len(stored.garbled)} rows that are invalid, or were changed after they were "
            f"written, were skipped: {', '.join(stored.garbled[:5])}."
        )
    gone = len(selected) - len(rows) if ending == "finished" else 0
    if gone:
        notes.append(
            f"{gone} stored rows are gone: something has changed the files of this run. Run "
            "again: only cells without a row run."
        )
    return RunResult(
        folder=folder,
        counts={name: number[name] for name in (*STATUSES, *number) if number[name]},
        open=len(selected) - len(rows),
        asked=asked,
        exit_code=_exit_code(len(selected), rows, ending),
        notes=(*notes, *more),
    )


def _exit_code(selected: int, rows: Sequence[Row], ending: Ending) -> int:
    """Exit code of a run; see the head of this file for the order."""
    statuses = {row.get("status") for row in rows}
    if ending in _CODES:
        return _CODES[ending]
    if not selected:
        return 4
    # A row that was stored in this run, and removed since, is no row.
    if (ending == "finished" and len(rows) < selected) or statuses.intersection(FAILURES):
        return 3
    if any(row.get("crosscheck") == "failed" for row in rows):
        return 1
    return 0 if "ok" in statuses else 4
