"""Supervised worker of another machine, which stays between batches."""

import atexit
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sysid_bench.harness.work.new_rows import NewRows
from sysid_bench.harness.work.supervise import WorkerSet, no_progress
from sysid_bench.harness.work.worker_process import Job, WorkerSettings
from sysid_bench.types import Row


@dataclass(frozen=True)
class Limits:
    """Limits of cells: s, threads, bytes."""

    timeout: float
    threads: int
    memory: float | None


@dataclass(frozen=True)
class Answer:
    """Rows of a batch, and the files that its cells wrote below artifacts."""

    rows: tuple[Row, ...]
    files: Mapping[str, bytes]


class BatchWorker:
    """One worker process with hard limits, warm between batches, in a folder of its own.

    Its thread lives as long as the seat: a worker ends with the thread that started it.
    """

    def __init__(self, limits: Limits) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="sysid_bench_seat_"))
        settings = WorkerSettings(
            self._folder, limits.timeout, limits.threads, memory=limits.memory
        )
        self._supervisor = WorkerSet(settings, 1, False, no_progress)
        self._arriving = NewRows(self._folder)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="seat")
        atexit.register(self.close)

    def answer(self, jobs: Sequence[Job]) -> Answer:
        """Compute the jobs; every cell has a row."""
        return self._thread.submit(self._answer, jobs).result()

    def interrupt(self) -> None:
        """Let a call of `answer` raise KeyboardInterrupt soon; signals call this at any time."""
        self._supervisor.interrupt()

    def close(self) -> None:
        """End the worker, and remove the folder."""
        atexit.unregister(self.close)
        self._supervisor.interrupt()
        self._thread.shutdown()
        self._supervisor.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _answer(self, jobs: Sequence[Job]) -> Answer:
        artifacts = self._folder / "artifacts"
        ending = self._supervisor.work([_with_artifacts(job, artifacts) for job in jobs])
        if ending == "interrupted":
            raise KeyboardInterrupt
        self._arriving.update()
        rows = [self._arriving.rows.pop(cell["id"]) for job in jobs for cell in job.cells]
        found = filter(Path.is_file, sorted(artifacts.rglob("*")))
        files = {str(file.relative_to(artifacts)): file.read_bytes() for file in found}
        shutil.rmtree(artifacts, ignore_errors=True)
        return Answer(tuple(rows), files)


def _with_artifacts(job: Job, folder: Path) -> Job:
    argument: Any = job.argument
    if isinstance(argument, Mapping) and "artifacts" in argument:
        argument = {**argument, "artifacts": str(folder)}
    return replace(job, argument=argument)
