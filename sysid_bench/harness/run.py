"""Run a suite, or continue a run: only cells without a row are executed.

Exit codes, the first that applies: 130 interrupted; 5 the machines of the executor are gone; 0
other shards have all selected cells; 4 no cell was selected; 3 a selected cell is failed, timeout,
crash, memory or lost; 1 a robot's cross-check failed; 4 no row is ok; 0. Codes 3 and 1 precede the
second 4 because they give its reason.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

from sysid_bench import package_folders
from sysid_bench.errors import FAILURES, UsageError, unknown_name
from sysid_bench.harness.cell import Cell, PlannedRow
from sysid_bench.harness.executors.executor import Executor, RunEnd, Work, executor_of
from sysid_bench.harness.job import job_of
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.run_frames import frames_of_run
from sysid_bench.harness.shard import Shard
from sysid_bench.harness.stale_rows import current_fingerprint, is_stale, stale_cells, stale_note
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import Suite, load_suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.suite.origin import origin_of, selection_words
from sysid_bench.harness.suite.third_party_code import code_note, third_party_names
from sysid_bench.harness.work.supervise import Ending, OnEvent, no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.harness.worker_names import worker_names
from sysid_bench.input_files import is_folder
from sysid_bench.types import Row
from sysid_bench.units import quantity
from sysid_bench.version_fields import environment
from sysid_bench.words import MOST_LOSSES, STATUSES

Rerun = Literal["failed", "stale", "all"]
EXECUTE: Final = "sysid_bench.experiments.execute:execute"
_RERUNS: Final = ("failed", "stale", "all")
_CODES: Final[Mapping[Ending, int]] = {"interrupted": 130, "lost": 5}
_Fingerprint = Callable[[Cell], str]


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
    cells; `executor` names what computes them (see harness/executors/executor.py). `on_event` gets
    ("code", {note}) where third-party code will run, ("plan", {cells, open, tasks, seconds}), then
    the events of the executor. Raises UsageError before any run.
    """
    request = _Request(
        select, limit, shard, timeout=timeout, rerun=rerun, jobs=jobs, fail_fast=fail_fast
    )
    request.check()
    on_event = on_event or no_progress
    chosen = executor_of(executor)
    with nullcontext(names) if names else worker_names(robots_dir) as known:
        options = _SuiteOptions(known, overrides or {}, robots_dir, large, request.words)
        folder = _run_folder(suite_or_folder, out, options)
    robots_dir = robots_dir or folder.suite.robots_folder
    plugins = third_party_names(folder.suite, robots_dir)
    if plugins:
        on_event("code", {"note": code_note(plugins)})  # before it runs
    source = _JobSource(folder, call, robots_dir, has_code=bool(plugins))
    return _run_selected(request, source, chosen, on_event)


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

    def check(self) -> None:
        """Raise UsageError for a value that no run can have."""
        if self.timeout is not None:
            _seconds(self.timeout)
        if self.rerun is not None and self.rerun not in _RERUNS:
            raise unknown_name("way to rerun", self.rerun, _RERUNS)
        _check_positive("limit", self.limit)
        _check_positive("jobs", self.jobs)

    @property
    def words(self) -> tuple[str, ...]:
        """Words of the command line that choose the cells."""
        return selection_words(self.select, self.limit, self.shard)

    def selected(self, plan: Plan) -> tuple[Cell, ...]:
        """Cells that are chosen."""
        cells = plan.select(self.select)
        if self.shard is not None:
            own = self.shard.experiments(plan.cells)
            cells = tuple(cell for cell in cells if cell.experiment in own)
        return cells[: self.limit]

    def has_empty_shard(self, plan: Plan, selected: Sequence[Cell]) -> bool:
        """True where cells are chosen, and other shards have them all."""
        return self.shard is not None and not selected and bool(plan.select(self.select))

    def unmatched(self, plan: Plan, selected: Sequence[Cell]) -> Sequence[str]:
        """Sentences on the values for which no cell was chosen."""
        return plan.unknown_values(self.select) if self.select and not selected else ()

    def worker_settings(self, folder: RunFolder, descriptor: int | None) -> WorkerSettings:
        """Limits of each cell: of the suite, but for the time limit that was given."""
        limits = folder.suite.run
        return WorkerSettings(
            folder=folder.path,
            timeout=_seconds(limits.timeout if self.timeout is None else self.timeout),
            threads=limits.threads,
            keep_open=() if descriptor is None else (descriptor,),
            memory=quantity(limits.memory, "B"),
        )

    def todo(
        self, selected: Iterable[Cell], rows: Mapping[str, Row], fingerprint: _Fingerprint
    ) -> list[Cell]:
        """Cells that have to run, by their stored rows."""
        return [
            cell
            for cell in selected
            if cell.id not in rows or self._is_repeated(cell, rows[cell.id], fingerprint)
        ]

    def _is_repeated(self, cell: Cell, row: Row, fingerprint: _Fingerprint) -> bool:
        if self.rerun == "all":
            return True
        if row.get("status") == "lost" and row.get("losses", 1) < MOST_LOSSES:
            return True
        if self.rerun == "failed":
            return row.get("status") not in ("ok", "unsupported")
        return self.rerun == "stale" and is_stale(row, fingerprint(cell))


def _check_positive(word: str, number: int | None) -> None:
    if number is not None and number < 1:
        raise UsageError(f"{word} is {number}; give 1 or more, or leave it out.")


def _folders(suite: Suite, robots_dir: Path | None) -> tuple[Path, ...]:
    """Folders with the files of a suite."""
    return tuple(path.resolve() for path in (suite.folder, robots_dir) if path is not None)


class _Machines:
    """Writes env.json: this machine, and those elsewhere that compute."""

    def __init__(self, folder: RunFolder, has_work: bool, on_event: OnEvent) -> None:
        self._folder, self._on_event = folder, on_event
        self._found = environment()
        if has_work:
            folder.write_environment(self._found)

    def on_event(self, kind: str, data: Mapping[str, Any]) -> None:
        if kind != "machine":
            self._on_event(kind, data)
            return
        machines = {**self._found.get("machines", {}), data["id"]: dict(data)}
        self._found = {**self._found, "machines": machines}
        self._folder.write_environment(self._found)


def _others(selected: Iterable[Cell], todo: Iterable[Cell]) -> list[Cell]:
    repeated = {cell.id for cell in todo}
    return [cell for cell in selected if cell.id not in repeated]


def _seconds(timeout: float | str) -> float:
    seconds = quantity(timeout, "s")
    if seconds <= 0:
        raise UsageError(f"The timeout is {timeout!r}; give a positive time, as '60 s'.")
    return seconds


@dataclass(frozen=True)
class _SuiteOptions:
    """Options of reading and expanding a suite."""

    names: Names
    overrides: Mapping[str, str]
    robots_dir: Path | None
    large: bool
    selection: tuple[str, ...]


def _run_folder(source: Suite | str | Path, out: Path | None, options: _SuiteOptions) -> RunFolder:
    """Open the run folder `source`, or make one of a suite."""
    if not isinstance(source, Suite) and is_folder(Path(source)):
        return _open_run(Path(source), out, options)
    suite = source if isinstance(source, Suite) else _loaded_suite(str(source), options)
    plan = cells_of_suite(suite, options.names, large=options.large)
    return RunFolder.new(out or Path("reports") / suite.name, suite, plan, environment())


def _open_run(path: Path, out: Path | None, options: _SuiteOptions) -> RunFolder:
    """Open a run folder; raise UsageError for options that only a suite takes."""
    if out is not None and out.resolve() != path.resolve():
        raise UsageError(
            f"{str(path)!r} is a run itself; it continues in its own folder, without -o."
        )
    if options.overrides:
        raise UsageError(f"{str(path)!r} is a run: its suite is frozen; --set needs a suite.")
    return RunFolder.open(path)


def _loaded_suite(source: str, options: _SuiteOptions) -> Suite:
    """Return the suite that `source` names, with its origin."""
    suite = load_suite(package_folders.suite(source), options.names, options.overrides)
    origin = origin_of(suite, source, options.robots_dir, options.overrides, options.selection)
    return suite.model_copy(update={"origin": origin})


def _by_experiment(cells: Iterable[Cell]) -> list[list[Cell]]:
    """Group cells by experiment: those of one group share its data, and are one job."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(cell.experiment, []).append(cell)
    return list(groups.values())


@dataclass(frozen=True)
class _JobSource:
    """Jobs of the experiments of a run folder."""

    folder: RunFolder
    call: str
    robots_dir: Path | None
    has_code: bool  # third-party plug-ins in the suite

    @cached_property
    def _fingerprint(self) -> Callable[[Cell], str]:
        return current_fingerprint(self.folder.suite, self.robots_dir)

    def fingerprint(self, cell: Cell) -> str:
        """Fingerprint of all that a cell depends on now."""
        return self._fingerprint(cell)

    def work(
        self,
        todo: Sequence[Cell],
        stored: Mapping[str, Row],
        settings: WorkerSettings,
        request: _Request,
    ) -> Work:
        """Return the jobs of some cells, one for each experiment, and what they take."""
        losses = {name: row["losses"] for name, row in stored.items() if row.get("losses")}
        return Work(
            jobs=[self._job(group, losses) for group in _by_experiment(todo)],
            settings=settings,
            seconds={cell.id: cell.seconds for cell in todo},
            folders=_folders(self.folder.suite, self.robots_dir),
            workers=request.jobs or os.cpu_count() or 1,
            fail_fast=request.fail_fast,
        )

    def _job(self, cells: Sequence[Cell], losses: Mapping[str, int]) -> Job:
        now = {cell.id: self.fingerprint(cell) for cell in cells}
        argument = job_of(cells, self.folder.suite, self.robots_dir, self.has_code) | {
            "fingerprints": now,
            "artifacts": str(self.folder.path.resolve() / "artifacts"),
        }
        heads = (PlannedRow(cell, now[cell.id], losses.get(cell.id, 0)) for cell in cells)
        group = " ".join(cells[0].labels[key] for key in ("robot", "payload"))
        return Job(self.call, argument, tuple(heads), group)


def _run_selected(
    request: _Request, source: _JobSource, executor: Executor, on_event: OnEvent
) -> RunResult:
    """Compute the selected cells that have to run, and write the frames of the run."""
    folder = source.folder
    selected = request.selected(folder.plan)
    with folder.lock() as descriptor:
        stored = folder.first_fields().rows
        todo = request.todo(selected, stored, source.fingerprint)
        settings = request.worker_settings(folder, descriptor)
        work = source.work(todo, stored, settings, request)
        on_event("plan", _announcement(selected, work))
        ended = _compute(work, folder, executor, on_event)
        del work  # the jobs of a million cells: consolidation needs the memory
        folder.write_frames()
        kept = _others(selected, todo)
        stale = stale_note(len(stale_cells(kept, stored, source.fingerprint)))
    unmatched = request.unmatched(folder.plan, selected)
    notes = (*filter(None, [stale]), *unmatched, *ended.notes)
    result = _result(folder, selected, todo, ended.ending, notes)
    if request.has_empty_shard(folder.plan, selected):
        empty = f"Shard {request.shard} has no cell: other shards have them all."
        return replace(result, exit_code=0, notes=(*result.notes, empty))
    return result


def _compute(work: Work, folder: RunFolder, executor: Executor, on_event: OnEvent) -> RunEnd:
    """Let the executor do the work, if there is any, while the run is consolidated."""
    with frames_of_run(folder, work.settings.keep_open, on_event) as heard:
        heard = _Machines(folder, bool(work.jobs), heard).on_event
        return executor.work(work, heard) if work.jobs else RunEnd("finished")


def _announcement(selected: Sequence[Cell], work: Work) -> dict[str, Any]:
    """Data of the event "plan": expected seconds by cell are the weights of a progress bar."""
    return {
        "cells": len(selected),
        "open": len(work.seconds),
        "tasks": len(work.jobs),
        "seconds": work.seconds,
    }


def _result(
    folder: RunFolder,
    selected: Sequence[Cell],
    todo: Sequence[Cell],
    ending: Ending,
    more: Iterable[str],
) -> RunResult:
    stored = folder.first_fields()
    rows = [stored.rows[cell.id] for cell in selected if cell.id in stored.rows]
    number = Counter(str(row.get("status")) for row in rows)
    counts = {name: number[name] for name in dict.fromkeys((*STATUSES, *number)) if number[name]}
    return RunResult(
        folder=folder,
        counts=counts,
        open=len(selected) - len(rows),
        asked=len(todo),
        exit_code=_exit_code(selected, rows, ending),
        notes=(*_notes(stored.torn, stored.garbled), *_gone(selected, rows, ending), *more),
    )


def _are_gone(selected: Sequence[Cell], rows: Sequence[Row], ending: Ending) -> bool:
    """True where rows that were stored in this run have been removed since."""
    return ending == "finished" and len(rows) < len(selected)


def _gone(selected: Sequence[Cell], rows: Sequence[Row], ending: Ending) -> Iterable[str]:
    """Note on cells whose row was stored in this run, and removed since."""
    if _are_gone(selected, rows, ending):
        yield (
            f"{len(selected) - len(rows)} stored rows are gone: something has changed the files of "
            "this run. Run again: only cells without a row run."
        )


def _exit_code(selected: Sequence[Cell], rows: Sequence[Row], ending: Ending) -> int:
    if ending in _CODES:
        return _CODES[ending]
    if not selected:
        return 4
    return 3 if _are_gone(selected, rows, ending) else _code_of_rows(rows)


def _code_of_rows(rows: Sequence[Row]) -> int:
    statuses = {row.get("status") for row in rows}
    if statuses.intersection(FAILURES):
        return 3
    if any(row.get("crosscheck") == "failed" for row in rows):
        return 1
    return 0 if "ok" in statuses else 4


def _notes(torn: int, garbled: Sequence[str]) -> Iterable[str]:
    if torn:
        yield f"{torn} unfinished rows of killed writers were skipped; their cells ran again."
    if garbled:
        yield (
            f"{len(garbled)} rows that are invalid, or were changed after they were written, were "
            f"skipped: {', '.join(garbled[:5])}."
        )
