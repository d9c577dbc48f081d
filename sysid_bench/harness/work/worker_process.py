"""Handle of one worker process: its pipes, its job, its time limit and its memory."""

import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from sysid_bench.experiments.spec import SEEDS
from sysid_bench.harness.work.confinement import method_environment, wanted_isolation
from sysid_bench.harness.work.process_tree import MARK, kill_group, kill_tree, memory_use, tree_of
from sysid_bench.harness.work.row_files import new_row_file, stored_rows
from sysid_bench.harness.work.run_process import end_of_process
from sysid_bench.types import Row

LIMIT: Final = 1 << 20
"""Bytes of output that a log file takes; a full file is kept as `*.old.log`."""
_TAIL: Final = 1 << 16


class BoundedLog:
    """Output of one worker: at most `LIMIT` bytes of its beginning, and its last 64 kB."""

    def __init__(self, path: Path) -> None:
        if path.exists() and path.stat().st_size >= LIMIT:
            path.replace(path.with_suffix(".old.log"))
        self._file = path.open("ab", buffering=0)
        self._room = LIMIT - self._file.tell()
        self._left_out = 0
        self._tail = b""
        self.total = 0

    def write(self, data: bytes) -> None:
        """Take output; a full disk loses it, and nothing else."""
        # A method may print without end: 410 MB in a test.
        kept = data[: self._room]
        self._store(kept)
        self._room -= len(kept)
        self._left_out += len(data) - len(kept)
        self._tail = (self._tail + data)[-_TAIL:]
        self.total += len(data)

    def output(self, start: int) -> str:
        """Return the output after its first `start` bytes, the last 64 kB at most."""
        length = min(self.total - start, len(self._tail))
        return self._tail[len(self._tail) - length :].decode(errors="replace")

    def close(self) -> None:
        """Write the end of an output that had no room."""
        if self._file.closed:
            return
        end = self._tail[max(0, len(self._tail) - self._left_out) :]
        if end:
            left_out = self._left_out - len(end)
            self._store(f"\n[{left_out} bytes of output are left out]\n".encode() + end)
        self._file.close()

    def _store(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._file.write(data)


Inbox = queue.SimpleQueue[tuple["Worker | None", dict[str, Any] | None]]
"""(worker, notice); None at the end of its output. (None, None) wakes the supervisor."""

_END_SECONDS = 10.0
"""Time for a process to end by itself, after its output and before its guard."""
_GUARD_SECONDS = 15.0
"""Time for a guard to end a worker and all that it has started."""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Job:
    """A call "module:function" with its argument. `cells` hold the first fields (id, labels) of the
    rows to compute, and the number of their `losses`; the function gets (argument, JobChannel).
    Jobs of one `group`, a robot and payload, share what a worker keeps in memory."""

    call: str
    argument: Any
    cells: tuple[Mapping[str, Any], ...]
    group: str = ""

    def of(self, cells: Mapping[str, Mapping[str, Any]]) -> "Job":
        """The same job for some of its cells."""
        return replace(self, cells=tuple(cells.values()))


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of all workers of a run. They inherit the descriptors `keep_open`: the lock of the
    run folder."""

    folder: Path
    timeout: float  # s, of a cell, and of the preparation of its experiment
    threads: int
    keep_open: tuple[int, ...] = ()
    memory: float | None = None  # bytes of a worker and of all that it starts
    start_timeout: float = 120.0  # s, for the start of a worker, where that is above `timeout`
    is_confined: bool = False  # as a method is (see confinement.py), with `folder` to write to


@dataclass(eq=False)
class Worker:
    """A process and its present job. Threads serve its pipes, so that a full pipe or a worker that
    does not read cannot block the supervisor."""

    name: str
    settings: WorkerSettings
    inbox: Inbox
    number: int = 0  # of the present job
    job: Job | None = None
    open_cells: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    current: str | None = None  # the cell that has begun
    has_begun: bool = False  # True once the job has begun a cell: its experiment is prepared
    has_left: bool = False  # True where the process takes no other job
    limit: float = float("inf")  # s, until the deadline
    deadline: float = float("inf")

    def __post_init__(self) -> None:
        self.rows_file = new_row_file(self.settings.folder / "cells", self.name)
        self.log_file = self.settings.folder / "logs" / f"{self.name}.log"
        self.log_file.parent.mkdir(exist_ok=True)
        self._log = BoundedLog(self.log_file)
        self._log_start = 0
        # A mark and a temporary folder of its own find, at the end, what third-party code has left.
        self._mark = uuid.uuid4().hex
        own = str(self.settings.folder) if self.settings.is_confined else None
        self._scratch = tempfile.mkdtemp(prefix="sysid_bench_", dir=own)
        environment = worker_environment(self.settings.threads)
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        # A new interpreter, not a fork, which would copy locks of the supervisor's threads; and not
        # multiprocessing's spawn, which needs a __main__ guard in the script of the caller.
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sysid_bench.harness.work.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={
                **(method_environment(self._scratch, environment) if own else environment),
                MARK: self._mark,
                "TMPDIR": self._scratch,
            },
            pass_fds=self.settings.keep_open,
            start_new_session=True,  # Ctrl-C reaches the supervisor alone
        )
        loops: tuple[Callable[[], None], ...] = (self._send, self._receive, self._keep_log)
        self._threads = [threading.Thread(target=loop, daemon=True) for loop in loops]
        for thread in self._threads:
            thread.start()
        self._outbox.put(
            {
                "parent": os.getpid(),
                # "" is the working directory, as long as nothing changes it.
                "path": [entry or os.getcwd() for entry in sys.path],
                "rows": str(self.rows_file),
                "memory": self.settings.memory,
                "confined": own and [own, [os.environ.get(SEEDS, "")], wanted_isolation()],
            }
        )

    @property
    def is_free(self) -> bool:
        """True where a job can be started."""
        return self.job is None and not self.has_left

    @property
    def is_late(self) -> bool:
        """True behind the deadline."""
        return self.deadline <= time.monotonic()

    def start_job(self, job: Job) -> None:
        """Send a job. It has the time limit of a start now, and its own once its module, which a
        fresh worker loads for seconds, is imported."""
        self.job, self.number = job, self.number + 1
        self.current, self.has_begun = None, False
        self.open_cells = {cell["id"]: cell for cell in job.cells}
        self._log_start = self._log.total
        # With its own limit of 5 s `ols` was a timeout on a busy machine, while it still imported.
        self.start_time_limit(max(self.settings.timeout, self.settings.start_timeout))
        losses = {cell["id"]: cell["losses"] for cell in job.cells if cell.get("losses")}
        self._outbox.put(
            {
                "number": self.number,
                "call": job.call,
                "argument": job.argument,
                "cells": list(self.open_cells),
                "losses": losses,
            }
        )

    def start_cell(self, cell: str) -> None:
        """Start the time limit of a cell."""
        self.current, self.has_begun = cell, True
        self._log_start = self._log.total
        self.start_time_limit()

    def close_cell(self, cell: str) -> None:
        """Forget a cell, whose row is stored."""
        # Each cell has the whole limit: 60 s of an experiment are 2.7 s for each of 22 methods.
        self.open_cells.pop(cell, None)
        self.current = None
        self.start_time_limit()

    def start_time_limit(self, limit: float | None = None) -> None:
        """Give a whole time limit again: preparation and each cell have one each."""
        self.limit = self.settings.timeout if limit is None else limit
        self.deadline = time.monotonic() + self.limit

    def end_job(self) -> None:
        """Forget the job."""
        self.job, self.current, self.open_cells, self.deadline = None, None, {}, float("inf")

    def interrupt(self, seconds: float) -> None:
        """Interrupt the job, as Ctrl-C does, which then has this time to end."""
        self.deadline = time.monotonic()
        if hasattr(os, "killpg"):
            self.deadline += seconds
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGINT)  # its guard takes no SIGINT

    def over_limit(self, *, memory: bool = True) -> tuple[str, str] | None:
        """Return status and sentence of a worker that is over its time limit, or that has more
        memory, with all that it started, than it may."""
        if self.is_late:
            return "timeout", f"longer than the limit of {self.limit:g} s"
        limit = self.settings.memory
        if memory and limit is not None and memory_use(self.process.pid, limit) > limit:
            return "memory", f"more than the limit of {limit / 1e9:g} GB"
        return None

    def kill(self) -> None:
        """Kill the process and all that it has started; its last notices are in the inbox then."""
        # Now: what a dead process leaves is below it no more.
        below = tree_of(self.process.pid)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.terminate()  # its guard ends all that it has started
            self.process.wait(timeout=_GUARD_SECONDS)
        kill_group(self.process)
        self.process.wait()
        kill_tree(self._mark, below)
        if self.process.stdin is not None:
            # Another sign than None, which is a message: it lets an idle worker end.
            self._outbox.put(StopIteration)
        for thread in self._threads:
            # The pipe may be kept open by a process that was not found; its thread is left then.
            thread.join(timeout=1.0)
        if not any(thread.is_alive() for thread in self._threads):
            for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
                if pipe is not None:
                    with contextlib.suppress(OSError):  # flushing to a process that has ended
                        pipe.close()
        self._log.close()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def end(self) -> tuple[str, str]:
        """Return status and sentence for the end of a process whose output has ended; one that goes
        on nevertheless, with closed pipes, is killed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=_END_SECONDS)
        has_ended = self.process.poll() is not None
        self.kill()
        if has_ended:
            status, reason = end_of_process(self.process.returncode)
            # The fatal error in the log since the cell began, or else its last line.
            lines = self.output().split("\n")
            written = [line.strip() for line in lines if line.strip()]
            fatal = [line for line in written if line.startswith("Fatal Python error")]
            text = (fatal or written[-1:] or [""])[0][:300]
            return status, reason + (f"; its last output: {text}" if text else "")
        return "crash", "its process closed the pipe of its result"

    def rows_of_open_cells(self) -> list[Row]:
        """Return the stored rows of open cells: the process has ended before their notices."""
        stored = stored_rows(self.rows_file) if self.open_cells else {}
        return [row for cell, row in stored.items() if cell in self.open_cells]

    def close(self) -> None:
        """Let an idle worker store its rows and end; kill one that does not within 5 s."""
        self._outbox.put(None)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5.0)
        self.kill()

    def output(self) -> str:
        """Return what the job has printed since it or its present cell began, at most 64 kB."""
        return self._log.output(self._log_start)

    def _keep_log(self) -> None:
        pipe = self.process.stderr
        assert pipe is not None
        while data := os.read(pipe.fileno(), 1 << 16):
            self._log.write(data)

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


def worker_environment(threads: int) -> Mapping[str, str]:
    """Return the environment of a process that imports this package, with a number of threads."""
    # In the environment, before the start: libraries of BLAS read these once, when they are loaded.
    environment = {**os.environ, **dict.fromkeys(_THREAD_VARIABLES, str(threads))}
    home = Path(__file__).resolve().parents[3]
    if home.name not in ("site-packages", "dist-packages"):
        # A checkout on sys.path that is not installed has to be on the path of workers too.
        paths = [str(home), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
    return environment
