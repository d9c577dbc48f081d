"""One worker process as its supervisor sees it."""

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

from sysid_bench.harness.work.row_files import new_row_file, stored_ids
from sysid_bench.types import Row

Inbox = queue.SimpleQueue[tuple["Worker", dict[str, Any] | None]]
"""(worker, what it told); None when it tells no more."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOG_TAIL = 65536


@dataclass(frozen=True)
class Task:
    """A call "module:function" with its argument; `cells` are the heads (id, labels) of the rows
    it owes. The function gets (argument, emit) and calls emit(row) once per cell."""

    call: str
    argument: Any
    cells: tuple[Row, ...]


@dataclass(frozen=True)
class WorkerSettings:
    """What all workers of a run share. `keep_open` is inherited: the lock of the run folder."""

    folder: Path
    timeout: float  # s
    threads: int
    keep_open: tuple[int, ...] = ()


@dataclass(eq=False)
class Worker:
    """A process and the task it is at. Two threads carry its pipes, so that no full pipe and no
    deaf worker can hold the supervisor."""

    name: str
    place: WorkerSettings
    inbox: Inbox
    task: Task | None = None
    owed: dict[str, Row] = field(default_factory=dict)
    deadline: float = float("inf")

    def __post_init__(self) -> None:
        self.rows_file = new_row_file(self.place.folder / "cells", self.name)
        self.log_file = self.place.folder / "logs" / f"{self.name}.log"
        self.log_file.parent.mkdir(exist_ok=True)
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        with self.log_file.open("ab") as log:
            self.log_start = log.tell()
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sysid_bench.harness.work.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=_environment(self.place.threads),
                pass_fds=self.place.keep_open,
                start_new_session=True,  # Ctrl-C is ours; and what it has started dies with it
            )
        self._threads = [
            threading.Thread(target=carry, daemon=True) for carry in (self._send, self._receive)
        ]
        for thread in self._threads:
            thread.start()
        path = [entry or os.getcwd() for entry in sys.path]
        self._outbox.put({"parent": os.getpid(), "path": path, "rows": str(self.rows_file)})

    def send_task(self, task: Task) -> None:
        """Hands over a task; its time runs from now, and again once its module is imported."""
        self.task = task
        self.owed = {cell["id"]: cell for cell in task.cells}
        self.log_start = self.log_file.stat().st_size
        self.restart_clock()
        cells = list(self.owed)
        self._outbox.put({"call": task.call, "argument": task.argument, "cells": cells})

    def restart_clock(self) -> None:
        """Start-up and computing have the whole limit each."""
        self.deadline = time.monotonic() + self.place.timeout

    def end_task(self) -> None:
        """The task is over."""
        self.task, self.owed, self.deadline = None, {}, float("inf")

    def kill(self) -> None:
        """Ends the process and all that it has started; rows that it stored are taken as done."""
        _kill_group(self.process)
        self.process.wait()
        if self.process.stdin is not None:
            self._outbox.put(StopIteration)
        for thread in self._threads:
            thread.join(timeout=1.0)
        if not any(thread.is_alive() for thread in self._threads):
            self._close_pipes()
        if self.owed:
            for done in stored_ids(self.rows_file):
                self.owed.pop(done, None)

    def stop(self) -> None:
        """Lets an idle worker store its rows and go; a deaf one is killed."""
        self._outbox.put(None)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5.0)
        self.kill()

    def stderr_tail(self) -> str:
        """The fatal error in the log since the task began, or else its last line."""
        with self.log_file.open("rb") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(self.log_start, size - _LOG_TAIL))
            lines = log.read().decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        fatal = [line for line in said if line.startswith("Fatal Python error")]
        return (fatal or said[-1:] or [""])[0][:300]

    def exit_reason(self) -> str:
        """How the process ended: "killed by SIGSEGV" or "exit code 3"."""
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
            except OSError:  # it is dead; the other thread tells
                return

    def _receive(self) -> None:
        pipe = self.process.stdout
        assert pipe is not None
        for line in pipe:
            try:
                self.inbox.put((self, json.loads(line)))
            except ValueError:  # torn by its death
                break
        self.inbox.put((self, None))

    def _close_pipes(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # what was buffered for a dead process
                    pipe.close()


def _environment(threads: int) -> Mapping[str, str]:
    environment = {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads))}
    home = Path(__file__).resolve().parents[3]
    if home.name not in ("site-packages", "dist-packages"):
        # A checkout that is on our path without being installed must be on the worker's as well.
        paths = [str(home), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
    return environment


def _kill_group(process: "subprocess.Popen[bytes]") -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
