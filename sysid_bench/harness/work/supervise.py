"""Supervision of worker processes: every cell of a started job gets a row, whatever happens.

The end of a worker, by itself (`crash`), over its limits (`timeout`, `memory`) or from outside
(`lost`), is the row of the cell that it was computing; the others of the experiment go on in a
fresh worker. An end before the first cell, while the experiment was prepared, is a row of each of
them.
"""

import contextlib
import queue
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Literal

from sysid_bench.errors import FAILURES, UsageError, reason_of
from sysid_bench.experiments.job_channel import usage_fields
from sysid_bench.harness.work.interrupt import on_interrupt
from sysid_bench.harness.work.row_files import RowWriter, new_row_file
from sysid_bench.harness.work.worker_process import Inbox, Job, Worker, WorkerSettings
from sysid_bench.types import Row

OnEvent = Callable[[str, Mapping[str, Any]], None]
"""Called as on_event("start", {worker, cells}), ("row", {id, status, reason}) and
("task", {worker, cells}) when a job has ended."""

Ending = Literal["finished", "stopped", "interrupted", "lost"]
"""End of a run; "lost": the machines that compute are gone."""
_POLL_SECONDS = 0.5
"""A dead worker whose pipe a grandchild keeps open is seen after this time, and so is memory."""


class JobQueue:
    """Jobs in order within their groups; each group goes to one worker while there are others.

    A worker that helps another takes the last job of its group: jobs that follow each other share
    most.
    """

    def __init__(self) -> None:
        self._groups: dict[str, deque[Job]] = {}
        self._owners: dict[str, Hashable] = {}  # group -> the first worker that had a job of it
        self._given: dict[Hashable, str] = {}  # worker -> group of its last job

    def __bool__(self) -> bool:
        return bool(self._groups)

    def add(self, jobs: Iterable[Job]) -> None:
        """Append jobs."""
        for job in jobs:
            self._groups.setdefault(job.group, deque()).append(job)

    def add_first(self, job: Job) -> None:
        """Let what is left of a started job be the next of its group."""
        self._groups.setdefault(job.group, deque()).appendleft(job)

    def select_job(self, worker: Hashable) -> Job:
        """Remove and return the next job of a worker: of its group; else of the first group that
        no worker has had; else the last one of the group with most jobs."""
        last = self._given.get(worker)
        free = (group for group in self._groups if group not in self._owners)
        if last is not None and last in self._groups:
            group = last
        elif (first := next(free, None)) is not None:
            group = first
        else:
            group = max(self._groups, key=lambda group: len(self._groups[group]))
        self._given[worker] = group
        jobs = self._groups[group]
        job = jobs.popleft() if self._owners.setdefault(group, worker) == worker else jobs.pop()
        if not jobs:
            del self._groups[group]
        return job


def supervise(
    jobs: Sequence[Job],
    settings: WorkerSettings,
    max_workers: int,
    fail_fast: bool = False,
    on_event: OnEvent | None = None,
) -> Ending:
    """Run all jobs on at most `max_workers` processes; rows go to `settings.folder`/cells.

    Return "stopped" after the first failure under `fail_fast`, "interrupted" after Ctrl-C,
    SIGTERM or SIGHUP: workers are killed, stored rows stay, and open cells have no row.
    """
    supervisor = WorkerSet(settings, max_workers, fail_fast, on_event or no_progress)
    with on_interrupt(supervisor.interrupt):
        try:
            ending = supervisor.work(jobs)
            if ending == "finished":
                supervisor.end_work()
            return ending
        except KeyboardInterrupt:
            return "interrupted"
        finally:
            supervisor.close()


@dataclass(eq=False)
class WorkerSet:
    """Worker processes that stay between calls of `work`, for one thread at a time."""

    settings: WorkerSettings
    max_workers: int
    fail_fast: bool
    on_event: OnEvent

    def __post_init__(self) -> None:
        # Not a pool of loky or concurrent.futures: where one of 200 tasks killed its process, they
        # lost 144 others (measured; joblib's run ended), and none can end a task that hangs.
        self.waiting = JobQueue()
        self.workers: list[Worker] = []
        # A signal handler puts into it: `put` of SimpleQueue may interrupt its own `get`, while the
        # lock of queue.Queue would block for ever.
        self.inbox: Inbox = queue.SimpleQueue()
        self.writer: RowWriter | None = None
        self.failures = 0
        self.interrupted = False
        self._next_look = 0.0

    def work(self, jobs: Sequence[Job]) -> Ending:
        """Assign jobs, read notices and check time limits until no job is left."""
        self.waiting.add(jobs)
        while self.waiting or any(worker.job for worker in self.workers):
            self._assign_jobs()
            # Wait for a notice until the next deadline, then handle all that have arrived
            soonest = min((worker.deadline for worker in self.workers), default=float("inf"))
            pause = max(0.0, min(_POLL_SECONDS, soonest - time.monotonic()))
            try:
                worker, notice = self.inbox.get(timeout=pause)
                while True:
                    # Late notices of a worker that was settled: its cells have rows, or wait again.
                    if worker is not None and worker in self.workers:
                        self._handle_notice(worker, notice)
                    worker, notice = self.inbox.get_nowait()
            except queue.Empty:
                pass
            self._check_workers()
            if self.interrupted:
                return "interrupted"
            if self.fail_fast and self.failures:
                return "stopped"
        return "finished"

    def end_work(self) -> None:
        """Let idle workers store their rows and end."""
        while self.workers:
            self.workers.pop().close()

    def interrupt(self) -> None:
        """End soon; a signal calls this at any moment, so that nothing is done here."""
        self.interrupted = True
        self.inbox.put((None, None))

    def close(self) -> None:
        """Kill the remaining workers."""
        for worker in self.workers:
            worker.kill()
        if self.writer is not None:
            self.writer.close()

    def _assign_jobs(self) -> None:
        while self.waiting:
            # Processes stay from job to job: importing both engines again takes a second.
            worker = next((idle for idle in self.workers if idle.is_free), None)
            if worker is None:
                if len(self.workers) >= max(1, self.max_workers):
                    return
                names = map("worker{}".format, count(1))
                used = {one.name for one in self.workers}
                with write_errors(self.settings.folder):
                    name = next(name for name in names if name not in used)
                    worker = Worker(name, self.settings, self.inbox)
                self.workers.append(worker)
            worker.start_job(self.waiting.select_job(worker.name))
            self.on_event("start", {"worker": worker.name, "cells": list(worker.open_cells)})

    def _handle_notice(self, worker: Worker, notice: dict[str, Any] | None) -> None:
        if notice is None:
            self._end_worker(worker, *worker.end())
        # A fork that came back from a plug-in answers a second time (18 notices for 8 cells).
        elif notice.get("job") != worker.number or worker.job is None:
            return  # of a job that has ended
        elif "progress" in notice:
            return
        elif "begin" in notice:
            worker.start_time_limit()
        elif "cell" in notice:
            worker.start_cell(notice["cell"])
        elif "row" in notice:
            worker.close_cell(notice["row"])
            self._count(notice["row"], notice["status"], notice["reason"])
        else:
            self._handle_end(worker, notice)

    def _handle_end(self, worker: Worker, notice: Mapping[str, Any]) -> None:
        """Handle the last notice of a job: {done}, {failed}, {dead}, {full} or {left}."""
        if "full" in notice:
            raise _storage_error(self.settings.folder, notice["full"])
        worker.has_left = "left" in notice
        if "dead" in notice or worker.has_left:
            reason = notice.get("dead", "its process ended without a row")
            self._end_job(worker, notice.get("status", "failed"), reason)
        elif "done" in notice:
            call = worker.job.call if worker.job else ""
            self._settle(worker, worker.open_cells, "failed", f"{call} ended without a row.")
            self._close_job(worker)
        else:
            more = {"traceback": notice["traceback"]}
            self._settle(worker, worker.open_cells, notice["status"], notice["failed"], more)
            self._close_job(worker)

    def _check_workers(self) -> None:
        now = time.monotonic()
        look = now >= self._next_look
        if look:
            self._next_look = now + _POLL_SECONDS
            gone = [one.rows_file for one in self.workers if not one.rows_file.exists()]
            if gone:  # its further rows would be lost
                raise UsageError(
                    f"{str(gone[0])!r} was removed or moved while its run went on; rows may be "
                    "gone. Run again: only cells without a row run."
                )
        for worker in list(self.workers):
            # One that ended behind its deadline is a timeout, whatever its last signal was.
            if worker.process.poll() is not None and not worker.is_late:
                self._end_worker(worker, *worker.end())
            elif end := worker.over_limit(memory=look and worker.job is not None):
                worker.kill()
                self._end_worker(worker, *end)

    def _end_worker(self, worker: Worker, status: str, reason: str) -> None:
        """Settle what a process that is gone leaves."""
        # Handle the last notices of a process that is gone, and the rows that it did not
        # announce: each row is counted once
        others = list[tuple[Worker | None, dict[str, Any] | None]]()
        with contextlib.suppress(queue.Empty):
            while True:
                sender, notice = self.inbox.get_nowait()
                if sender is not worker:
                    others.append((sender, notice))
                elif notice is not None:
                    self._handle_notice(worker, notice)
        for item in others:
            self.inbox.put(item)
        for row in worker.rows_of_open_cells():
            worker.close_cell(row["id"])
            self._count(row["id"], row.get("status"), row.get("reason"))
        self._end_job(worker, status, reason)
        self.workers.remove(worker)

    def _end_job(self, worker: Worker, status: str, reason: str) -> None:
        """End the job of a process that is gone: its present cell is settled, the others go on.

        Without a present cell the experiment was being prepared, which is a row of every cell.
        """
        if worker.job is None:
            return
        # The present cell alone, or the order of the methods would decide whom a crash costs.
        present = worker.current
        if present in worker.open_cells:
            self._settle(worker, [present], status, reason)
        elif not worker.has_begun:
            place = f"while the experiment was prepared: {reason}"
            self._settle(worker, worker.open_cells, status, place)
        if worker.open_cells:
            self.waiting.add_first(worker.job.of(worker.open_cells))
        self._close_job(worker)

    def _close_job(self, worker: Worker) -> None:
        if worker.job is None:
            return
        cells = [cell["id"] for cell in worker.job.cells if cell["id"] not in worker.open_cells]
        worker.end_job()
        self.on_event("task", {"worker": worker.name, "cells": cells})

    def _settle(
        self,
        worker: Worker,
        cells: Iterable[str],
        status: str,
        reason: str,
        more: Mapping[str, Any] | None = None,
    ) -> None:
        """Write rows with this status for cells of the present job."""
        for cell in list(cells):
            row = row_of_end(worker.open_cells.pop(cell), status, reason, more)
            with write_errors(self.settings.folder):
                # Most runs have no such row, and no such file.
                if self.writer is None:
                    file = new_row_file(self.settings.folder / "cells", "supervisor")
                    self.writer = RowWriter(file)
                self.writer.write(row)
            self._count(row["id"], row["status"], row["reason"])

    def _count(self, cell: str, status: Any, reason: Any) -> None:
        self.failures += status in FAILURES
        self.on_event("row", {"id": cell, "status": status, "reason": reason})


@contextmanager
def write_errors(folder: Path) -> Iterator[None]:
    """Report what the file system, or the machine, does not give to a run folder."""
    try:
        yield
    except OSError as error:
        raise _storage_error(folder, reason_of(error)) from error


def _storage_error(folder: Path, reason: str) -> UsageError:
    return UsageError(
        f"A row cannot be stored in {str(folder)!r} ({reason}). Make room and run again: stored "
        "rows stay, and only open cells run."
    )


def row_of_end(
    head: Mapping[str, Any], status: str, reason: str, more: Mapping[str, Any] | None = None
) -> Row:
    """Return the row of a cell without an answer, from its first fields."""
    row = {key: value for key, value in head.items() if key != "losses"}
    if status == "lost":  # once more
        row["losses"] = head.get("losses", 0) + 1
    return {**row, "status": status, "reason": reason, **(more or {}), **usage_fields(None)}


def no_progress(kind: str, data: Mapping[str, Any]) -> None:
    """Take an event that nobody listens to."""
