"""Run a suite, or continue a run: only cells without a row are executed.

Exit codes, the first that applies: 130 interrupted; 5 the machines of the executor are gone; 4 no
cell was selected; 3 a selected cell is failed, timeout, crash, memory or lost; 1 a robot's
cross-check failed; 4 no row is ok; 0. Codes 3 and 1 precede the second 4 because they give its
reason.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

from sysid_bench import package_folders
from sysid_bench.errors import FAILURES, UsageError, unknown_name
from sysid_bench.harness.cell import Cell, PlannedHead
from sysid_bench.harness.executors.executor import RunEnd, Work, executor_of
from sysid_bench.harness.job import job_of
from sysid_bench.harness.plan import Plan, cells_of_suite
from sysid_bench.harness.run_frames import frames_of_run
from sysid_bench.harness.shard import Shard
from sysid_bench.harness.stale_rows import current_fingerprint, is_stale, stale_cells, stale_note
from sysid_bench.harness.store import RunFolder
from sysid_bench.harness.suite.load_suite import Suite, load_suite
from sysid_bench.harness.suite.names import Names
from sysid_bench.harness.suite.origin import origin_of, selection_words
from sysid_bench.harness.suite.third_party_code import code_note, third_party_names
from sysid_bench.harness.work.supervise import Ending, OnEvent, ignore
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.harness.worker_names import worker_names
from sysid_bench.input_files import is_folder
from sysid_bench.types import Row
from sysid_bench.units import quantity
from sysid_bench.versions import environment
from sysid_bench.vocabulary import MOST_LOSSES, STATUSES

Rerun = Literal["failed", "stale", "all"]
EXECUTE: Final = "sysid_bench.experiments.execute:execute"
_RERUNS: Final = ("failed", "stale", "all")


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
    _check(rerun, limit, jobs, timeout)
    on_event = on_event or ignore
    chosen = executor_of(executor)
    with nullcontext(names) if names else worker_names(robots_dir) as known:
        words = selection_words(select, limit, shard)
        options = _SuiteOptions(known, overrides or {}, robots_dir, large, words)
        folder = _run_folder(suite_or_folder, out, options)
    note = code_note(third_party_names(folder.suite))
    if note:
        on_event("code", {"note": note})
    selected = _selected(folder.plan, select, shard)[:limit]
    source = _JobSource(folder, call, robots_dir or folder.suite.robots_folder)
    with folder.lock() as descriptor:
        stored = folder.first_fields().rows
        todo = _todo(selected, stored, rerun, source.fingerprint)
        work = Work(
            jobs=source.jobs(todo, stored),
            settings=_worker_settings(folder, timeout, descriptor),
            seconds={cell.id: cell.seconds for cell in todo},
            folders=_folders(folder.suite, source.robots_dir),
            workers=jobs or os.cpu_count() or 1,
            fail_fast=fail_fast,
        )
        on_event("plan", _announcement(selected, work))
        with frames_of_run(folder, work.settings.keep_open, on_event) as heard:
            heard = _Machines(folder, bool(work.jobs), heard).on_event
            ended = chosen.work(work, heard) if work.jobs else RunEnd("finished")
        del work, heard  # the jobs of a million cells: consolidation needs the memory
        folder.write_frames()
        kept = _others(selected, todo)
        stale = stale_note(len(stale_cells(kept, stored, source.fingerprint)))
    unmatched = folder.plan.unknown_values(select) if select and not selected else ()
    notes = (*filter(None, [stale]), *unmatched, *ended.notes)
    return _result(folder, selected, todo, ended.ending, notes)


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


def _worker_settings(
    folder: RunFolder, timeout: float | str | None, descriptor: int | None
) -> WorkerSettings:
    limits = folder.suite.run
    return WorkerSettings(
        folder=folder.path,
        timeout=_seconds(limits.timeout if timeout is None else timeout),
        threads=limits.threads,
        keep_open=() if descriptor is None else (descriptor,),
        memory=quantity(limits.memory, "B"),
    )


def _selected(plan: Plan, select: str | None, shard: Shard | None) -> tuple[Cell, ...]:
    cells = plan.select(select)
    return cells if shard is None else shard.cells(cells)


def _check(
    rerun: str | None, limit: int | None, jobs: int | None, timeout: float | str | None
) -> None:
    if timeout is not None:
        _seconds(timeout)
    if rerun is not None and rerun not in _RERUNS:
        raise unknown_name("way to rerun", rerun, _RERUNS)
    for word, number in (("limit", limit), ("jobs", jobs)):
        if number is not None and number < 1:
            raise UsageError(f"{word} is {number}; give 1 or more, or leave it out.")


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
        if out is not None and out.resolve() != Path(source).resolve():
            raise UsageError(
                f"{str(source)!r} is a run itself; it continues in its own folder, without -o."
            )
        if options.overrides:
            raise UsageError(f"{str(source)!r} is a run: its suite is frozen; --set needs a suite.")
        return RunFolder.open(Path(source))
    if isinstance(source, Suite):
        suite = source
    else:
        suite = load_suite(package_folders.suite(str(source)), options.names, options.overrides)
        origin = origin_of(
            suite, str(source), options.robots_dir, options.overrides, options.selection
        )
        suite = suite.model_copy(update={"origin": origin})
    plan = cells_of_suite(suite, options.names, large=options.large)
    return RunFolder.new(out or Path("reports") / suite.name, suite, plan, environment())


def _todo(
    selected: Sequence[Cell],
    rows: Mapping[str, Row],
    rerun: Rerun | None,
    fingerprint: Callable[[Cell], str],
) -> list[Cell]:
    def wanted(cell: Cell) -> bool:
        row = rows.get(cell.id)
        if row is None or rerun == "all":
            return True
        if row.get("status") == "lost" and row.get("losses", 1) < MOST_LOSSES:
            return True
        if rerun == "failed":
            return row.get("status") not in ("ok", "unsupported")
        return rerun == "stale" and is_stale(row, fingerprint(cell))

    return [cell for cell in selected if wanted(cell)]


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

    @cached_property
    def _fingerprint(self) -> Callable[[Cell], str]:
        return current_fingerprint(self.folder.suite, self.robots_dir)

    def fingerprint(self, cell: Cell) -> str:
        """Fingerprint of all that a cell depends on now."""
        return self._fingerprint(cell)

    def jobs(self, cells: Iterable[Cell], stored: Mapping[str, Row]) -> list[Job]:
        """One job for each experiment."""
        losses = {name: row["losses"] for name, row in stored.items() if row.get("losses")}
        return [self._job(group, losses) for group in _by_experiment(cells)]

    def _job(self, cells: Sequence[Cell], losses: Mapping[str, int]) -> Job:
        now = {cell.id: self.fingerprint(cell) for cell in cells}
        argument = job_of(cells, self.folder.suite, self.robots_dir) | {
            "fingerprints": now,
            "artifacts": str(self.folder.path.resolve() / "artifacts"),
        }
        heads = (PlannedHead(cell, now[cell.id], losses.get(cell.id, 0)) for cell in cells)
        group = " ".join(cells[0].labels[key] for key in ("robot", "payload"))
        return Job(self.call, argument, tuple(heads), group)


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


def _gone(selected: Sequence[Cell], rows: Sequence[Row], ending: Ending) -> Iterable[str]:
    """Note on cells whose row was stored in this run, and removed since."""
    if ending == "finished" and len(rows) < len(selected):
        yield (
            f"{len(selected) - len(rows)} stored rows are gone: something has changed the files of "
            "this run. Run again: only cells without a row run."
        )


def _exit_code(selected: Sequence[Cell], rows: Sequence[Row], ending: Ending) -> int:
    statuses = {row.get("status") for row in rows}
    if ending == "interrupted":
        return 130
    if ending == "lost":
        return 5
    if not selected:
        return 4
    if statuses.intersection(FAILURES) or (ending == "finished" and len(rows) < len(selected)):
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
