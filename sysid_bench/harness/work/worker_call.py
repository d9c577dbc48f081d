"""Calls of functions in a worker process, for code that may hang, crash or change its process."""

import json
import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
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
    return a value within this time; a second one ends the worker. A worker that `is_confined` has
    the environment, the files and the namespaces of a third-party method.
    """

    timeout: float
    memory: float | None = MEMORY
    interrupt_timeout: float = 0.0
    is_confined: bool = False
    output: str = field(default="", init=False)  # that a worker had printed when it ended

    def __post_init__(self) -> None:
        self._inbox: Inbox = queue.SimpleQueue()
        self._worker: Worker | None = None
        self._folder = TemporaryDirectory(prefix="sysid_bench_")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
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
            # Here, for the error: the thread that sends would die of it, and the call would hang.
            json.dumps(argument)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{title}: its settings are not JSON values ({error}).") from error
        # On the first call: a suite without third-party names starts no process.
        if self._worker is None:
            folder = Path(self._folder.name)
            settings = WorkerSettings(
                folder, self.timeout, 1, memory=self.memory, is_confined=self.is_confined
            )
            self._worker = Worker("worker1", settings, self._inbox)
        self._worker.start_job(Job(function, argument, cells=()))
        try:
            notice = self._last_notice(self._worker, on_progress)
        # In the midst of a call, after Ctrl-C: the worker cannot take another one.
        except BaseException:
            self._end()
            raise
        if "done" in notice:
            return notice["done"]
        self._end()
        if "dead" in notice:
            raise WorkerError(f"{title}: {notice['dead']}. {_REST}", notice["status"])
        failure = WorkerError(f"{title}: {notice['failed']}", notice["status"])
        failure.add_note(notice["traceback"])
        raise failure

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
            pause = max(0.0, min(_POLL_SECONDS, worker.deadline - time.monotonic()))
            end, notice = None, dict[str, Any]()
            try:
                sender, heard = self._inbox.get(timeout=pause)
                if sender is worker:  # one that has ended may still have notices queued
                    notice, end = heard or {}, worker.end() if heard is None else None
            except queue.Empty:
                has_ended = worker.process.poll() is not None and not worker.is_late
                # No notice: a dead worker whose pipe is held open, or one over its limits.
                end = worker.end() if has_ended else worker.over_limit()
            if end is not None:
                return {"status": end[0], "dead": end[1]}
            if "begin" in notice:
                worker.start_time_limit()
            elif "progress" in notice:
                on_progress(notice["progress"])
            elif notice.keys() & {"done", "failed", "dead"}:
                return notice

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
