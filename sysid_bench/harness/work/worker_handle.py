"""Handle of one worker process: its pipes, its job and its time limit."""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sysid_bench.harness.work.row_files import new_row_file, stored_cells
from sysid_bench.types import Row

Inbox = queue.SimpleQueue[tuple["Worker", dict[str, Any] | None]]
"""(worker, notice); None at the end of its output."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOG_TAIL = 65536


@dataclass(frozen=True)
class Job:
    """A call "module:function" with its argument. `cells` hold the first fields (id, labels) of the
    rows to compute; the function gets (argument, emit) and calls emit(row) once per cell."""

    call: str
    argument: Any
    cells: tuple[Row, ...]


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of all workers of a run. They inherit the descriptors `keep_open`: the lock of the
    run folder."""

    folder: Path
    timeout: float  # s
    threads: int
    keep_open: tuple[int, ...] = ()


@dataclass(eq=False)
class Worker:
    """A process and its present job. Two threads serve its pipes, so that a full pipe or a worker
    that does not read cannot block the supervisor."""

    name: str
    settings: WorkerSettings
    inbox: Inbox
    job: Job | None = None
    open_cells: dict[str, Row] = field(default_factory=dict)
    deadline: float = float("inf")

    def __post_init__(self) -> None:
        self.rows_file = new_row_file(self.settings.folder / "cells", self.name)
        self.log_file = self.settings.folder / "logs" / f"{self.name}.log"
        self.log_file.parent.mkdir(exist_ok=True)
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        with self.log_file.open("ab") as log:
            self.log_start = log.tell()
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sysid_bench.harness.work.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=_environment(self.settings.threads),
                pass_fds=self.settings.keep_open,
                start_new_session=True,  # Ctrl-C reaches the supervisor alone
            )
        self._threads = [
            threading.Thread(target=loop, daemon=True) for loop in (self._send, self._receive)
        ]
        for thread in self._threads:
            thread.start()
        path = [entry or os.getcwd() for entry in sys.path]
        self._outbox.put({"parent": os.getpid(), "path": path, "rows": str(self.rows_file)})

    def start_job(self, task: Job) -> None:
        """Send a job; its time limit counts from now, and again once its module is imported."""
        self.job = task
        self.open_cells = {cell["id"]: cell for cell in task.cells}
        self.log_start = self.log_file.stat().st_size
        self.restart_timeout()
        cells = list(self.open_cells)
        self._outbox.put({"call": task.call, "argument": task.argument, "cells": cells})

    def restart_timeout(self) -> None:
        """Give the job the whole time limit again: start-up and computing have one each."""
        self.deadline = time.monotonic() + self.settings.timeout

    def end_job(self) -> None:
        """Forget the job."""
        self.job, self.open_cells, self.deadline = None, {}, float("inf")

    def kill(self) -> None:
        """Kill the process and its children; cells whose rows it stored are not open any more."""
        _kill_group(self.process)
        self.process.wait()
        if self.process.stdin is not None:
            self._outbox.put(StopIteration)
        for thread in self._threads:
            thread.join(timeout=1.0)
        if not any(thread.is_alive() for thread in self._threads):
            self._close_pipes()
        if self.open_cells:
            for done in stored_cells(self.rows_file):
                self.open_cells.pop(done, None)

    def stop(self) -> None:
        """Let an idle worker store its rows and end; kill one that does not within 5 s."""
        self._outbox.put(None)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5.0)
        self.kill()

    def error_text(self) -> str:
        """Return the fatal error in the log since the job began, or else its last line."""
        with self.log_file.open("rb") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(self.log_start, size - _LOG_TAIL))
            lines = log.read().decode(errors="replace").split("\n")
        written = [line.strip() for line in lines if line.strip()]
        fatal = [line for line in written if line.startswith("Fatal Python error")]
        return (fatal or written[-1:] or [""])[0][:300]

    def reason(self) -> str:
        """Return a sentence on the end of the process, with its signal or exit code."""
        code = self.process.returncode
        if code >= 0:
            return f"the worker ended with exit code {code}"
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        return f"the worker was killed by {name}"

    def _send(self) -> None:
        pipe = self.process.stdin
        assert pipe is not None
        while (message := self._outbox.get()) is not StopIteration:
            try:
                pipe.write(json.dumps(message).encode() + b"\n")
                pipe.flush()
            except OSError:  # the process has ended; _receive reports it
                return

    def _receive(self) -> None:
        pipe = self.process.stdout
        assert pipe is not None
        for line in pipe:
            try:
                self.inbox.put((self, json.loads(line)))
            except ValueError:  # a line cut off by the end of the process
                break
        self.inbox.put((self, None))

    def _close_pipes(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # flushing to a process that has ended
                    pipe.close()


def _environment(threads: int) -> Mapping[str, str]:
    environment = {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads))}
    home = Path(__file__).resolve().parents[3]
    if home.name not in ("site-packages", "dist-packages"):
        # A checkout on sys.path that is not installed has to be on the path of workers too.
        paths = [str(home), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
    return environment


def _kill_group(process: "subprocess.Popen[bytes]") -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
