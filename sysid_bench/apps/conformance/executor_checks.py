"""Cells of the conformance kit of executors: each does what its name asks for, then has a row."""

import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from sysid_bench.apps.conformance.findings import Finding, Kit, KitCase, Law, finding_of_error
from sysid_bench.errors import UsageError
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.harness.executor import Executor, Local, RunEnd, Work
from sysid_bench.harness.work.row_files import lines, parse_row, row_files
from sysid_bench.harness.work.supervise import OnEvent, no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.types import Row
from sysid_bench.words import MACHINE_FIELDS

STATUS: Final[Mapping[str, str]] = MappingProxyType(
    {"hangs": "timeout", "crashes": "crash", "raises": "failed"}
)
"""Status of the row of a cell "NAME.ACT"."""


def run_cells(argument: Mapping[str, Any], channel: JobChannel) -> None:
    """Write a row for each asked cell, with the sum of numbers drawn from `argument`["seed"]."""
    for cell in argument["cells"]:
        if cell not in channel.cells:
            continue
        channel.start_cell(cell)
        match cell.partition(".")[2]:
            case "hangs":
                time.sleep(1000)
            case "crashes":
                os.kill(os.getpid(), getattr(signal, "SIGSEGV", signal.SIGTERM))
            case "raises":
                raise ArithmeticError("asked for")
        # By cell and seed alone, so that any machine and order of cells gives the same row.
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
        case = _FolderCase("jobs of the kit", Path(folder))
        try:
            _done(executor, case.new_folder(), _jobs(1, cells=1))
        except UsageError:
            raise
        except Exception as error:
            return [finding_of_error(error, "computes a job", "one cell")]
        return _ExecutorKit(executor, case).findings()


@dataclass(frozen=True, eq=False)
class _FolderCase(KitCase):
    folder: Path

    def new_folder(self) -> Path:
        """An empty folder, for each law its own."""
        return Path(tempfile.mkdtemp(dir=self.folder))


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
    texts = (line.text for file in row_files(folder / "cells") for line in lines(file))
    rows = filter(None, map(parse_row, texts))
    return ended, [{k: v for k, v in row.items() if k not in MACHINE_FIELDS} for row in rows]


def _count_error(rows: Sequence[Row], jobs: Sequence[Job]) -> str | None:
    """Return which cells have no row, several, or were not asked for."""
    counts = Counter(row["id"] for row in rows)
    owed = {cell["id"] for job in jobs for cell in job.cells}
    wrong = [f"{name}: {counts[name]} rows" for name in sorted(owed) if counts[name] != 1]
    wrong += [f"{name}: nobody asked for it" for name in sorted(counts.keys() - owed)]
    return "; ".join(wrong[:4]) or None


class _ExecutorKit(Kit[_FolderCase]):
    runs = "computes a job"

    @Law("each cell has one row, as on one machine")
    def rows(self) -> str | None:
        """The work finishes, and each cell has the row that worker processes of this machine
        give."""
        jobs = _jobs(4)
        ended, rows = _done(self.plugin, self.case.new_folder(), jobs)
        if ended.ending != "finished":
            return f"work() ended {ended.ending!r}, not 'finished': {'; '.join(ended.notes)}"
        if error := _count_error(rows, jobs):
            return error
        _, local = _done(Local(), self.case.new_folder(), jobs)
        expected = {row["id"]: row for row in local}
        other = [row["id"] for row in rows if row != expected[row["id"]]]
        return f"{other[0]} has another row than on one machine" if other else None

    @Law("limits are hard, and an end costs its own cell")
    def limits(self) -> str | None:
        """Hanging, crashing and failing cells cost themselves alone: the first, a middle, the
        last."""
        jobs = _jobs(4, acts=tuple(STATUS))
        ended, rows = _done(self.plugin, self.case.new_folder(), jobs)
        error = _count_error(rows, jobs)
        if ended.ending != "finished" or error:
            return f"work() ended {ended.ending!r}; {error or 'each cell has a row'}"
        for row in rows:
            wanted = STATUS.get(row["id"].partition(".")[2], "ok")
            if row["status"] != wanted:
                return f"{row['id']} is {row['status']!r}, not {wanted!r}"
        return None

    @Law("an interrupted run resumes")
    def resumes(self) -> str | None:
        """Ctrl-C ends the work, stored rows stay, and the cells without a row can be computed
        after."""
        jobs, folder = _jobs(6), self.case.new_folder()

        def interrupt(kind: str, data: Mapping[str, Any]) -> None:
            if kind == "row":
                signal.raise_signal(signal.SIGINT)

        # A process that was started in the background may ignore SIGINT.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            ended, rows = _done(self.plugin, folder, jobs, interrupt)
        except KeyboardInterrupt:
            return "KeyboardInterrupt left work(); return RunEnd('interrupted')"
        finally:
            signal.signal(signal.SIGINT, before)
        if ended.ending not in ("interrupted", "finished"):
            return f"work() ended {ended.ending!r} after Ctrl-C, not 'interrupted'"
        stored = {row["id"] for row in rows}
        rest = (job.of({c["id"]: c for c in job.cells if c["id"] not in stored}) for job in jobs)
        if still_open := [job for job in rest if job.cells]:
            _, rows = _done(self.plugin, folder, still_open)
        return _count_error(rows, jobs)

    @Law("reports each row")
    def reports(self) -> str | None:
        """The event `row` is reported once for each cell, with its status."""
        heard: list[tuple[str, str]] = []

        def hear(kind: str, data: Mapping[str, Any]) -> None:
            if kind == "row":
                heard.append((data["id"], data["status"]))

        _, rows = _done(self.plugin, self.case.new_folder(), _jobs(2, acts=("raises",)), hear)
        if sorted(heard) == sorted((row["id"], row["status"]) for row in rows):
            return None
        return f"{len(heard)} rows were reported, not as stored"

    @Law("stops at the first failure when asked")
    def stops(self) -> str | None:
        folder = self.case.new_folder()
        (folder / "cells").mkdir()
        work = _work(folder, _jobs(8, acts=("raises",)), fail_fast=True)
        ended = self.plugin.work(work, no_progress)
        if ended.ending == "stopped":
            return None
        return f"work() ended {ended.ending!r}, not 'stopped'"
