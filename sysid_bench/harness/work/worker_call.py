"""Calls of functions in a worker process, for code that may hang, crash or change its process."""

import json
import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Final, Self

from sysid_bench.errors import SysidBenchError, UsageError
from sysid_bench.harness.work.worker_process import Inbox, Job, Worker, WorkerSettings

MEMORY: Final = 4e9
"""Default limit (bytes) of a call."""
_POLL_SECONDS: Final = 0.2
_REST: Final = "It ran in a process of its own, which has ended; all else is as it was."

OnProgress = Callable[[Any], None]


def no_progress(progress: Any) -> None:
    pass


class WorkerError(SysidBenchError):
    """A call in a worker that ended without a value; `status` is that of a cell with this end."""

    def __init__(self, message: str, status: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(eq=False)
class CallWorker:
    """Worker process for calls one after the other; it starts with the first call, and again after
    a call that has ended it. `timeout` (s) holds for each call, its start-up apart.

    An interrupt ends the worker, or with `interrupt_timeout` (s) interrupts the function, which may
    return a value within this time; a second one ends the worker.
    """

    timeout: float
    memory: float | None = MEMORY
    interrupt_timeout: float = 0.0
    output: str = field(default="", init=False)  # that a worker had printed when it ended

    def __post_init__(self) -> None:
        self._inbox: Inbox = queue.SimpleQueue()
        self._worker: Worker | None = None
        self._folder = TemporaryDirectory(prefix="sysid_bench_")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._end()
        self._folder.cleanup()

    def call(
        self, function: str, argument: Any, title: str, on_progress: OnProgress = no_progress
    ) -> Any:
        """Return the JSON value of "module:function", called with (argument, JobChannel), whose
        progress is given to `on_progress`.

        Raises WorkerError, whose message begins with `title`, where it raises, hangs, ends its
        process or needs more memory than the limit; UsageError for an argument that is not JSON.
        """
        try:
            json.dumps(argument)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{title}: its settings are not JSON values ({error}).") from error
        if self._worker is None:
            settings = WorkerSettings(
                Path(self._folder.name), self.timeout, threads=1, memory=self.memory
            )
            self._worker = Worker("worker1", settings, self._inbox)
        worker = self._worker
        worker.start_job(Job(function, argument, cells=()))
        try:
            notice = self._last_notice(worker, on_progress)
        except BaseException:
            self._end()
            raise
        if "done" in notice:
            return notice["done"]
        self._end()
        raise _error(title, notice)

    def _last_notice(self, worker: Worker, on_progress: OnProgress) -> Mapping[str, Any]:
        try:
            return self._wait(worker, on_progress)
        except KeyboardInterrupt:
            if self.interrupt_timeout <= 0.0:
                raise
            worker.interrupt(self.interrupt_timeout)
            notice = self._wait(worker, no_progress)
            if "done" not in notice:
                raise
            return notice

    def _wait(self, worker: Worker, on_progress: OnProgress) -> Mapping[str, Any]:
        """Return the last notice of the present job, or {dead, status} of a worker that ended."""
        while True:
            notice = self._next_notice(worker) or {}
            if "begin" in notice:
                worker.start_time_limit()
            elif "progress" in notice:
                on_progress(notice["progress"])
            elif notice.keys() & {"done", "failed", "dead"}:
                return notice

    def _next_notice(self, worker: Worker) -> Mapping[str, Any] | None:
        """Return what a worker reports soon, or {dead, status} of one that ended; None without."""
        pause = max(0.0, min(_POLL_SECONDS, worker.deadline - time.monotonic()))
        try:
            sender, notice = self._inbox.get(timeout=pause)
        except queue.Empty:
            return self._over_limit(worker)
        if sender is not worker:  # a worker that has ended may still have notices queued
            return None
        return self._end_of(worker) if notice is None else notice

    def _over_limit(self, worker: Worker) -> Mapping[str, Any] | None:
        if worker.deadline <= time.monotonic():
            reason = f"it ran longer than the limit of {worker.limit:g} s"
            return {"dead": reason, "status": "timeout"}
        if worker.process.poll() is not None:
            return self._end_of(worker)
        if worker.is_out_of_memory():
            reason = f"it took more memory than the limit of {(self.memory or 0.0) / 1e9:g} GB"
            return {"dead": reason, "status": "memory"}
        return None

    def _end_of(self, worker: Worker) -> Mapping[str, Any]:
        status, reason = worker.end()
        return {"dead": reason, "status": status}

    def _end(self) -> None:
        if self._worker is not None:
            self._worker.kill()
            self.output = self._worker.output()  # whole, now that no thread reads any more
            self._worker = None


def worker_call(
    function: str, argument: Any, title: str, timeout: float, memory: float | None = MEMORY
) -> Any:
    """Call a function in a worker of its own (see `CallWorker.call`)."""
    with CallWorker(timeout, memory) as worker:
        return worker.call(function, argument, title)


def _error(title: str, notice: Mapping[str, Any]) -> WorkerError:
    if "failed" in notice:
        error = WorkerError(f"{title}: {notice['failed']}", notice["status"])
        error.add_note(notice["traceback"])
        return error
    return WorkerError(f"{title}: {notice['dead']}. {_REST}", notice["status"])
