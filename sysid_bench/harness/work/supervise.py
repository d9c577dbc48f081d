"""Supervision of worker processes: every cell of a started job gets a row, whatever happens.

A job that raises gives `failed` rows, one that exceeds the time limit `timeout` rows, one that ends
its process `crash` rows. Other jobs are not affected.
"""

import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any, Literal

from sysid_bench.harness.work.row_files import RowWriter, new_row_file
from sysid_bench.harness.work.worker_handle import Inbox, Job, Worker, WorkerSettings
from sysid_bench.types import Row
from sysid_bench.vocabulary import FAILURES

OnEvent = Callable[[str, Mapping[str, Any]], None]
"""Called as on_event("start", {worker, cells}), ("row", {id, status, reason}) and
("task", {worker, cells}) when a job has ended."""

Ending = Literal["finished", "stopped", "interrupted"]
_POLL_SECONDS = 0.5
"""A dead worker whose pipe a grandchild keeps open is seen after this time."""


def supervise(
    jobs: Sequence[Job],
    settings: WorkerSettings,
    max_workers: int,
    fail_fast: bool = False,
    on_event: OnEvent | None = None,
) -> Ending:
    """Run all jobs on at most `max_workers` processes; rows go to `settings.folder`/cells.

    Return "stopped" after the first failure under `fail_fast`, "interrupted" after Ctrl-C or
    SIGTERM: workers are killed, stored rows stay, and open cells have no row.
    """
    supervisor = _Supervisor(jobs, settings, max_workers, fail_fast, on_event or _ignore)
    try:
        with _sigterm_as_interrupt():
            return supervisor.run()
    except KeyboardInterrupt:
        return "interrupted"
    finally:
        supervisor.close()


@dataclass(eq=False)
class _Supervisor:
    jobs: Sequence[Job]
    settings: WorkerSettings
    max_workers: int
    fail_fast: bool
    on_event: OnEvent

    def __post_init__(self) -> None:
        self.waiting = deque(self.jobs)
        self.workers: list[Worker] = []
        self.inbox: Inbox = queue.SimpleQueue()
        self.writer: RowWriter | None = None
        self.failures = 0

    def run(self) -> Ending:
        """Assign jobs, read notices and check time limits until no job is left."""
        while self.waiting or any(worker.job for worker in self.workers):
            self._assign_jobs()
            self._listen()
            self._check_workers()
            if self.fail_fast and self.failures:
                return "stopped"
        for worker in self.workers:
            worker.stop()
        self.workers.clear()
        return "finished"

    def close(self) -> None:
        """Kill the remaining workers."""
        for worker in self.workers:
            worker.kill()
        if self.writer is not None:
            self.writer.close()

    def _assign_jobs(self) -> None:
        while self.waiting:
            worker = next((idle for idle in self.workers if idle.job is None), None)
            if worker is None:
                if len(self.workers) >= max(1, self.max_workers):
                    return
                worker = self._start_worker()
            job = self.waiting.popleft()
            worker.start_job(job)
            self.on_event("start", {"worker": worker.name, "cells": list(worker.open_cells)})

    def _start_worker(self) -> Worker:
        used = {worker.name for worker in self.workers}
        names = (f"worker{i}" for i in range(1, self.max_workers + 2))
        name = next(name for name in names if name not in used)
        worker = Worker(name, self.settings, self.inbox)
        self.workers.append(worker)
        return worker

    def _listen(self) -> None:
        """Wait for a notice until the next deadline, then handle all that have arrived."""
        soonest = min((worker.deadline for worker in self.workers), default=float("inf"))
        pause = max(0.0, min(_POLL_SECONDS, soonest - time.monotonic()))
        try:
            worker, notice = self.inbox.get(timeout=pause)
            while True:
                if worker in self.workers:  # a worker that has ended may still have notices queued
                    self._handle_notice(worker, notice)
                worker, notice = self.inbox.get_nowait()
        except queue.Empty:
            pass

    def _handle_notice(self, worker: Worker, notice: dict[str, Any] | None) -> None:
        if notice is None:
            self._end_crashed(worker)
        elif "begin" in notice:
            worker.restart_timeout()
        elif "row" in notice:
            worker.open_cells.pop(notice["row"], None)
            self._count(notice["row"], notice["status"], notice["reason"])
        elif "done" in notice:
            call = worker.job.call if worker.job else ""
            self._end_job(worker, "failed", f"{call} ended without a row for this cell.")
        else:
            self._end_job(worker, "failed", notice["failed"], {"traceback": notice["traceback"]})

    def _check_workers(self) -> None:
        now = time.monotonic()
        for worker in list(self.workers):
            if worker.deadline <= now:
                worker.kill()
                reason = f"longer than the limit of {self.settings.timeout:g} s"
                self._end_job(worker, "timeout", reason)
                self.workers.remove(worker)
            elif worker.process.poll() is not None:
                self._end_crashed(worker)

    def _end_crashed(self, worker: Worker) -> None:
        worker.kill()
        text = worker.error_text()
        reason = worker.reason() + (f"; its last output: {text}" if text else "")
        self._end_job(worker, "crash", reason)
        self.workers.remove(worker)

    def _end_job(
        self, worker: Worker, status: str, reason: str, more: Mapping[str, Any] | None = None
    ) -> None:
        """End the job: its open cells get rows with this status."""
        if worker.job is None:
            return
        for cell in worker.open_cells.values():
            self._write({**cell, "status": status, "reason": reason, **(more or {})})
        cells = [cell["id"] for cell in worker.job.cells]
        worker.end_job()
        self.on_event("task", {"worker": worker.name, "cells": cells})

    def _write(self, row: Row) -> None:
        if self.writer is None:
            self.writer = RowWriter(new_row_file(self.settings.folder / "cells", "supervisor"))
        self.writer.append(row)
        self._count(row["id"], row["status"], row["reason"])

    def _count(self, cell: str, status: Any, reason: Any) -> None:
        self.failures += status in FAILURES
        self.on_event("row", {"id": cell, "status": status, "reason": reason})


def _ignore(kind: str, data: Mapping[str, Any]) -> None:
    pass


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C; signal handlers can be set in the main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
