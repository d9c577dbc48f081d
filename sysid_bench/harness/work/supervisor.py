"""Runs tasks in worker processes; every cell of a started task gets a row, whatever happens.

A task that raises gives `failed` rows, one that outlasts the limit `timeout` rows, one that takes
its process down `crash` rows; the other tasks do not notice.
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
from sysid_bench.harness.work.worker_handle import Inbox, Task, Worker, WorkerSettings
from sysid_bench.types import Row
from sysid_bench.vocabulary import FAILURES

OnEvent = Callable[[str, Mapping[str, Any]], None]
"""Called as on_event("start", {worker, cells}), ("row", {id, status, reason}) and
("task", {worker, cells}) when a task is over."""

Ending = Literal["finished", "stopped", "interrupted"]
_PULSE = 0.5  # s; how soon a death is seen whose pipe a grandchild keeps open


def supervise(
    tasks: Sequence[Task],
    place: WorkerSettings,
    jobs: int,
    fail_fast: bool = False,
    on_event: OnEvent | None = None,
) -> Ending:
    """Runs all tasks on at most `jobs` workers; rows go to `place.folder`/cells.

    "stopped" is the first failure under `fail_fast`, "interrupted" Ctrl-C or SIGTERM: workers are
    killed, stored rows stay, and open cells have no row.
    """
    run = _Supervision(tasks, place, jobs, fail_fast, on_event or _ignore)
    try:
        with _sigterm_as_interrupt():
            return run.work()
    except KeyboardInterrupt:
        return "interrupted"
    finally:
        run.close()


@dataclass(eq=False)
class _Supervision:
    tasks: Sequence[Task]
    place: WorkerSettings
    jobs: int
    fail_fast: bool
    on_event: OnEvent

    def __post_init__(self) -> None:
        self.waiting = deque(self.tasks)
        self.workers: list[Worker] = []
        self.inbox: Inbox = queue.SimpleQueue()
        self.writer: RowWriter | None = None
        self.failures = 0

    def work(self) -> Ending:
        """The loop: hand out tasks, listen, and look at the clock."""
        while self.waiting or any(worker.task for worker in self.workers):
            self._hand_out()
            self._listen()
            self._look_after()
            if self.fail_fast and self.failures:
                return "stopped"
        for worker in self.workers:
            worker.stop()
        self.workers.clear()
        return "finished"

    def close(self) -> None:
        """Kills who is left."""
        for worker in self.workers:
            worker.kill()
        if self.writer is not None:
            self.writer.close()

    def _hand_out(self) -> None:
        while self.waiting:
            worker = next((idle for idle in self.workers if idle.task is None), None)
            if worker is None:
                if len(self.workers) >= max(1, self.jobs):
                    return
                worker = self._hire()
            task = self.waiting.popleft()
            worker.send_task(task)
            self.on_event("start", {"worker": worker.name, "cells": list(worker.owed)})

    def _hire(self) -> Worker:
        taken = {worker.name for worker in self.workers}
        name = next(n for n in (f"worker{i}" for i in range(1, self.jobs + 2)) if n not in taken)
        worker = Worker(name, self.place, self.inbox)
        self.workers.append(worker)
        return worker

    def _listen(self) -> None:
        """Waits for the first notice until the next deadline, then takes all that are there."""
        soonest = min((worker.deadline for worker in self.workers), default=float("inf"))
        pause = max(0.0, min(_PULSE, soonest - time.monotonic()))
        try:
            worker, notice = self.inbox.get(timeout=pause)
            while True:
                if worker in self.workers:  # not one that was buried before
                    self._heed(worker, notice)
                worker, notice = self.inbox.get_nowait()
        except queue.Empty:
            pass

    def _heed(self, worker: Worker, notice: dict[str, Any] | None) -> None:
        if notice is None:
            self._bury(worker)
        elif "begin" in notice:
            worker.restart_clock()
        elif "row" in notice:
            worker.owed.pop(notice["row"], None)
            self._count(notice["row"], notice["status"], notice["reason"])
        elif "done" in notice:
            call = worker.task.call if worker.task else ""
            self._settle(worker, "failed", f"{call} ended without a row for this cell.")
        else:
            self._settle(worker, "failed", notice["failed"], {"traceback": notice["traceback"]})

    def _look_after(self) -> None:
        now = time.monotonic()
        for worker in list(self.workers):
            if worker.deadline <= now:
                worker.kill()
                reason = f"longer than the limit of {self.place.timeout:g} s"
                self._settle(worker, "timeout", reason)
                self.workers.remove(worker)
            elif worker.process.poll() is not None:
                self._bury(worker)

    def _bury(self, worker: Worker) -> None:
        worker.kill()
        words = worker.stderr_tail()
        reason = worker.exit_reason() + (f"; its last words: {words}" if words else "")
        self._settle(worker, "crash", reason)
        self.workers.remove(worker)

    def _settle(
        self, worker: Worker, status: str, reason: str, more: Mapping[str, Any] | None = None
    ) -> None:
        """The task is over: what it still owes becomes rows of ours."""
        if worker.task is None:
            return
        for cell in worker.owed.values():
            self._write({**cell, "status": status, "reason": reason, **(more or {})})
        cells = [cell["id"] for cell in worker.task.cells]
        worker.end_task()
        self.on_event("task", {"worker": worker.name, "cells": cells})

    def _write(self, row: Row) -> None:
        if self.writer is None:
            self.writer = RowWriter(new_row_file(self.place.folder / "cells", "supervisor"))
        self.writer.append(row)
        self._count(row["id"], row["status"], row["reason"])

    def _count(self, cell: str, status: Any, reason: Any) -> None:
        self.failures += status in FAILURES
        self.on_event("row", {"id": cell, "status": status, "reason": reason})


def _ignore(kind: str, data: Mapping[str, Any]) -> None:
    pass


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """SIGTERM stops a run as Ctrl-C does; only the main thread may ask for that."""
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
