"""Cells of the conformance kit of executors: each does what its name asks for, then has a row."""

import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import Finding, finding_of_error, findings_of
from sysid_bench.errors import UsageError
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.harness.executor import Executor, Local, RunEnd, Work
from sysid_bench.harness.work.row_files import lines, parse_row, row_files
from sysid_bench.harness.work.supervise import OnEvent, no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.types import Row
from sysid_bench.words import MACHINE_FIELDS


def _hang() -> None:
    time.sleep(1000)


def _crash() -> None:
    os.kill(os.getpid(), getattr(signal, "SIGSEGV", signal.SIGTERM))


def _raise() -> None:
    raise ArithmeticError("asked for")


ACTS: Final[Mapping[str, Callable[[], None]]] = MappingProxyType(
    {"hangs": _hang, "crashes": _crash, "raises": _raise}
)
"""What a cell "NAME.ACT" does before it would have a row."""

STATUS: Final[Mapping[str, str]] = MappingProxyType(
    {"hangs": "timeout", "crashes": "crash", "raises": "failed"}
)
"""Status of the row of such a cell."""


def run_cells(argument: Mapping[str, Any], channel: JobChannel) -> None:
    """Write a row for each asked cell, with the sum of numbers drawn from `argument`["seed"]."""
    for cell in argument["cells"]:
        if cell not in channel.cells:
            continue
        channel.start_cell(cell)
        ACTS.get(cell.partition(".")[2], lambda: None)()
        drawn = np.random.default_rng([argument["seed"], *cell.encode()]).normal(size=50)
        channel.write({"id": cell, "status": "ok", "sum": float(drawn.sum())})


SECONDS: Final = 3.0
"""Time limit of a cell that hangs; a sound one takes milliseconds."""

_CALL: Final = f"{run_cells.__module__}:{run_cells.__name__}"


def check_executor(executor: Executor) -> list[Finding]:
    """Return the findings of all laws on an executor, which has to be able to compute now.

    Raises UsageError where it says itself that it cannot.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            _done(executor, Path(folder), _jobs(1, cells=1))
        except UsageError:
            raise
        except Exception as error:
            return [finding_of_error(error, "computes a job", "one cell")]
    return findings_of(_LAWS, "jobs of the kit", executor)


def _jobs(count: int, cells: int = 3, acts: Sequence[str] = ()) -> list[Job]:
    """Return jobs of equal cells; act k is that of cell k of job k."""
    jobs = []
    for number in range(count):
        names = [f"job{number}cell{k}" for k in range(cells)]
        if number < len(acts):
            names[number] += f".{acts[number]}"
        argument = {"seed": number, "cells": names}
        jobs.append(Job(_CALL, argument, tuple({"id": name} for name in names)))
    return jobs


def _work(folder: Path, jobs: Sequence[Job], fail_fast: bool = False) -> Work:
    settings = WorkerSettings(folder, timeout=SECONDS, threads=1)
    return Work(jobs, settings, {}, (), workers=2, fail_fast=fail_fast)


def _done(
    executor: Executor, folder: Path, jobs: Sequence[Job], on_event: OnEvent = no_progress
) -> tuple[RunEnd, list[Row]]:
    """Return how the work ended, and the rows of the folder without fields of the machine."""
    (folder / "cells").mkdir(exist_ok=True)
    ended = executor.work(_work(folder, jobs), on_event)
    return ended, _rows(folder)


def _rows(folder: Path) -> list[Row]:
    texts = (line.text for file in row_files(folder / "cells") for line in lines(file))
    return [
        {key: value for key, value in row.items() if key not in MACHINE_FIELDS}
        for row in filter(None, map(parse_row, texts))
    ]


def _count_error(rows: Sequence[Row], jobs: Sequence[Job]) -> str | None:
    """Return which cells have no row, several, or were not asked for."""
    counts = Counter(row["id"] for row in rows)
    owed = {cell["id"] for job in jobs for cell in job.cells}
    wrong = [f"{name}: {counts[name]} rows" for name in sorted(owed) if counts[name] != 1]
    wrong += [f"{name}: nobody asked for it" for name in sorted(counts.keys() - owed)]
    return "; ".join(wrong[:4]) or None


def _in_folder(law: Callable[[Executor, Path], str | None]) -> Callable[[Executor], str | None]:
    """Return a law that has an empty folder of its own."""

    def held(executor: Executor) -> str | None:
        with tempfile.TemporaryDirectory() as folder:
            return law(executor, Path(folder))

    return held


def _same_rows(executor: Executor, folder: Path) -> str | None:
    """The work finishes, and each cell has the row that worker processes of this machine give."""
    jobs = _jobs(4)
    for name in ("own", "local"):
        (folder / name).mkdir()
    ended, rows = _done(executor, folder / "own", jobs)
    if ended.ending != "finished":
        return f"work() ended {ended.ending!r}, not 'finished': {'; '.join(ended.notes)}"
    if error := _count_error(rows, jobs):
        return error
    _, local = _done(Local(), folder / "local", jobs)
    expected = {row["id"]: row for row in local}
    other = [row["id"] for row in rows if row != expected[row["id"]]]
    return f"{other[0]} has another row than on one machine" if other else None


def _settles(executor: Executor, folder: Path) -> str | None:
    """Hanging, crashing and failing cells cost themselves alone: the first, a middle, the last."""
    jobs = _jobs(4, acts=tuple(STATUS))
    ended, rows = _done(executor, folder, jobs)
    error = _count_error(rows, jobs)
    if ended.ending != "finished" or error:
        return f"work() ended {ended.ending!r}; {error or 'each cell has a row'}"
    for row in rows:
        wanted = STATUS.get(row["id"].partition(".")[2], "ok")
        if row["status"] != wanted:
            return f"{row['id']} is {row['status']!r}, not {wanted!r}"
    return None


def _resumes(executor: Executor, folder: Path) -> str | None:
    """Ctrl-C ends the work, stored rows stay, and the cells without a row can be computed after."""
    jobs = _jobs(6)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        ended, rows = _done(executor, folder, jobs, _interrupt)
    except KeyboardInterrupt:
        return "KeyboardInterrupt left work(); return RunEnd('interrupted')"
    finally:
        signal.signal(signal.SIGINT, before)
    if ended.ending not in ("interrupted", "finished"):
        return f"work() ended {ended.ending!r} after Ctrl-C, not 'interrupted'"
    if rest := _open_jobs(jobs, {row["id"] for row in rows}):
        _, rows = _done(executor, folder, rest)
    return _count_error(rows, jobs)


def _interrupt(kind: str, data: Mapping[str, Any]) -> None:
    """Press Ctrl-C when a row comes."""
    if kind == "row":
        signal.raise_signal(signal.SIGINT)


def _open_jobs(jobs: Iterable[Job], stored: set[str]) -> list[Job]:
    """Jobs with the cells that are not stored."""
    rest = (
        job.of({cell["id"]: cell for cell in job.cells if cell["id"] not in stored}) for job in jobs
    )
    return [job for job in rest if job.cells]


def _reports(executor: Executor, folder: Path) -> str | None:
    """The event `row` is reported once for each cell, with its status."""
    jobs = _jobs(2, acts=("raises",))
    heard: list[tuple[str, str]] = []

    def hear(kind: str, data: Mapping[str, Any]) -> None:
        if kind == "row":
            heard.append((data["id"], data["status"]))

    _, rows = _done(executor, folder, jobs, hear)
    expected = sorted((row["id"], row["status"]) for row in rows)
    return None if sorted(heard) == expected else f"{len(heard)} rows were reported, not as stored"


def _stops(executor: Executor, folder: Path) -> str | None:
    """The first failure ends the work where that was asked for."""
    (folder / "cells").mkdir()
    ended = executor.work(_work(folder, _jobs(8, acts=("raises",)), fail_fast=True), no_progress)
    return None if ended.ending == "stopped" else f"work() ended {ended.ending!r}, not 'stopped'"


_LAWS: Final = {
    "each cell has one row, as on one machine": _in_folder(_same_rows),
    "limits are hard, and an end costs its own cell": _in_folder(_settles),
    "an interrupted run resumes": _in_folder(_resumes),
    "reports each row": _in_folder(_reports),
    "stops at the first failure when asked": _in_folder(_stops),
}
