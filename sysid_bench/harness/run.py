"""Runs a suite, or goes on with a run: only cells without a row are executed.

Exit codes, the first that holds: 130 interrupted; 4 no cell was selected; 3 a selected cell is
failed, timeout or crash; 1 a robot's cross-check failed; 4 nothing was measured (no row is ok);
0. Codes 3 and 1 come before the second 4, for they say why nothing was measured.
"""

import os
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from sysid_bench import places
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.fingerprint import cell_fingerprint
from sysid_bench.harness.job import job_of
from sysid_bench.harness.plan import Cell, expand
from sysid_bench.harness.store import RunFolder
from sysid_bench.harness.suite.load_suite import Suite, load_suite
from sysid_bench.harness.suite.model import Origin
from sysid_bench.harness.suite.names import Names, installed_names
from sysid_bench.harness.work.supervisor import Ending, OnEvent, supervise
from sysid_bench.harness.work.worker_handle import Task, WorkerSettings
from sysid_bench.types import Row
from sysid_bench.units import quantity
from sysid_bench.versions import environment
from sysid_bench.vocabulary import FAILURES, STATUSES

Rerun = Literal["failed", "stale", "all"]
EXECUTE: Final = "sysid_bench.experiments.execute:execute"
_RERUNS: Final = ("failed", "stale", "all")


@dataclass(frozen=True)
class RunResult:
    """What became of the selected cells. `counts` is by status, `open` counts those without a
    row, `asked` those that this call set out to run."""

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
    timeout: float | str | None = None,
    rerun: Rerun | None = None,
    fail_fast: bool = False,
    on_event: OnEvent | None = None,
    call: str = EXECUTE,
    names: Names | None = None,
    robots_dir: Path | None = None,
    overrides: Mapping[str, str] | None = None,
) -> RunResult:
    """Executes the selected cells that have no row; a run folder needs no suite any more.

    `limit` takes the first of the selected cells, in the order of the plan, whether they have a
    row or not; `timeout` (s) and `jobs` (default: the cores) change no cell. `on_event` gets the
    supervisor's events and, first, ("plan", {cells, open, tasks, seconds}). Raises UsageError
    before anything runs.
    """
    _check(rerun, limit, jobs)
    if timeout is not None:
        _seconds(timeout)
    names = names or installed_names(robots_dir)
    folder = _folder(suite_or_folder, out, names, overrides, robots_dir)
    suite, plan = folder.suite, folder.plan
    robots_dir = robots_dir or suite.robots_dir
    selected = plan.select(select)[:limit]
    limit_seconds = _seconds(suite.run.timeout if timeout is None else timeout)
    with folder.lock() as descriptor:
        now = partial(
            cell_fingerprint,
            robots_dir=robots_dir,
            folder=suite.folder,
            metrics=[entry.spec for entry in suite.metric],
        )
        todo = _todo(selected, folder.rows().rows, rerun, now)
        tasks = [_task(cells, folder, call, robots_dir, now) for cells in _by_experiment(todo)]
        if tasks:
            folder.write_env(environment())
        if on_event is not None:
            on_event("plan", _announcement(selected, todo, tasks))
        place = WorkerSettings(
            folder.path,
            limit_seconds,
            suite.run.threads,
            () if descriptor is None else (descriptor,),
        )
        ending = supervise(tasks, place, jobs or os.cpu_count() or 1, fail_fast, on_event)
        folder.write_frames()
    result = _result(folder, selected, todo, ending)
    if select and not selected:
        return replace(result, notes=(*result.notes, *plan.uncovered(select)))
    return result


def _check(rerun: str | None, limit: int | None, jobs: int | None) -> None:
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


def _folder(
    source: Suite | str | Path,
    out: Path | None,
    names: Names,
    overrides: Mapping[str, str] | None,
    robots_dir: Path | None,
) -> RunFolder:
    """The run folder to work in: opened where `source` is one, made of a suite otherwise."""
    if not isinstance(source, Suite) and Path(source).is_dir():
        if out is not None and out.resolve() != Path(source).resolve():
            raise UsageError(
                f"{str(source)!r} is a run itself; it goes on where it is, without -o."
            )
        if overrides:
            raise UsageError(f"{str(source)!r} is a run: its suite is frozen; --set needs a suite.")
        return RunFolder.open(Path(source))
    if isinstance(source, Suite):
        suite = source
    else:
        suite = load_suite(places.suite(str(source)), names, overrides)
        suite = _signed(suite, str(source), robots_dir, overrides or {})
    return RunFolder.create(
        out or Path("reports") / suite.name, suite, expand(suite, names), environment()
    )


def _signed(
    suite: Suite, source: str, robots_dir: Path | None, overrides: Mapping[str, str]
) -> Suite:
    """The suite with what a later command needs to go on: the user's robots, and what was typed."""
    words = ["sysid-bench", "run", source]
    words += ["--robots", str(robots_dir)] if robots_dir else []
    words += [word for key, value in overrides.items() for word in ("--set", f"{key}={value}")]
    robots = str(robots_dir.resolve()) if robots_dir else None
    origin = Origin(folder=str(suite.folder), robots=robots, command=shlex.join(words))
    return suite.model_copy(update={"origin": origin})


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
        if rerun == "failed":
            return row.get("status") not in ("ok", "unsupported")
        return rerun == "stale" and row.get("fingerprint") != fingerprint(cell)

    return [cell for cell in selected if wanted(cell)]


def _by_experiment(cells: Iterable[Cell]) -> list[list[Cell]]:
    """The open cells of an experiment are one task: they share its data."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(cell.experiment, []).append(cell)
    return list(groups.values())


def _task(
    cells: Sequence[Cell],
    folder: RunFolder,
    call: str,
    robots_dir: Path | None,
    fingerprint: Callable[[Cell], str],
) -> Task:
    prints = {cell.id: fingerprint(cell) for cell in cells}
    argument = job_of(cells, folder.suite, robots_dir) | {
        "fingerprints": prints,
        "artifacts": str(folder.path.resolve() / "artifacts"),
    }
    return Task(call, argument, tuple({**c.head, "fingerprint": prints[c.id]} for c in cells))


def _announcement(
    selected: Sequence[Cell], todo: Sequence[Cell], tasks: Sequence[Task]
) -> dict[str, Any]:
    """What a progress bar weighs its parts with: expected seconds by cell."""
    return {
        "cells": len(selected),
        "open": len(todo),
        "tasks": len(tasks),
        "seconds": {cell.id: cell.seconds for cell in todo},
    }


def _result(
    folder: RunFolder, selected: Sequence[Cell], todo: Sequence[Cell], ending: Ending
) -> RunResult:
    stored = folder.rows()
    rows = [stored.rows[cell.id] for cell in selected if cell.id in stored.rows]
    met = Counter(str(row.get("status")) for row in rows)
    counts = {status: met[status] for status in dict.fromkeys((*STATUSES, *met)) if met[status]}
    return RunResult(
        folder=folder,
        counts=counts,
        open=len(selected) - len(rows),
        asked=len(todo),
        exit_code=_exit_code(selected, rows, ending),
        notes=tuple(_notes(stored.torn, stored.garbled)),
    )


def _exit_code(selected: Sequence[Cell], rows: Sequence[Row], ending: Ending) -> int:
    statuses = {row.get("status") for row in rows}
    if ending == "interrupted":
        return 130
    if not selected:
        return 4
    if statuses.intersection(FAILURES):
        return 3
    if any(row.get("crosscheck") == "failed" for row in rows):
        return 1
    return 0 if "ok" in statuses else 4


def _notes(torn: int, garbled: Sequence[str]) -> Iterable[str]:
    if torn:
        yield f"{torn} rows were cut off when a writer was killed; their cells ran again."
    if garbled:
        yield f"{len(garbled)} lines are no rows and were passed over: {', '.join(garbled[:5])}."
