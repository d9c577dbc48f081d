"""Batches of a run on an engine that may lose them: rows are written here alone, each once.

The engine's workers compute batches (`batch.run_batch`), which are pure: what is lost is
computed again, and only rows that are still owed are written.
"""

import contextlib
import math
import queue
import threading
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

from sysid_bench.apps.clusters.batch import (
    Batch,
    BatchAnswer,
    BatchWorker,
    environment_fields,
)
from sysid_bench.errors import FAILURES, UsageError
from sysid_bench.harness.executor import RunEnd, Work
from sysid_bench.harness.work import supervise
from sysid_bench.harness.work.interrupt import on_interrupt
from sysid_bench.harness.work.row_files import RowWriter, new_row_file
from sysid_bench.harness.work.supervise import Ending, JobQueue, OnEvent
from sysid_bench.harness.work.worker_process import Job
from sysid_bench.types import Row
from sysid_bench.words import MACHINE_FIELDS

SECONDS: Final = 0.5
"""Expected cost of a batch: long beside its transport, short beside the loss of a machine."""
MOST_CELLS: Final = 2000


class BatchQueue:
    """Jobs of a run, in order within their groups; a worker stays with its group as in JobQueue."""

    def __init__(self, jobs: Sequence[Job], seconds: Mapping[str, float]) -> None:
        self._jobs = JobQueue()
        self._jobs.add(jobs)
        self._seconds = seconds
        self._cost = sum(map(self._cost_of, jobs))
        self._cells = sum(len(job.cells) for job in jobs)

    def __bool__(self) -> bool:
        return bool(self._jobs)

    def select_batch(self, worker: Hashable, parts: int) -> tuple[Job, ...]:
        """Remove and return the next jobs of a worker: as many as cost 0.5 s or have 2000 cells,
        but one of `parts` of what waits, so that batches get smaller towards the end."""
        most_cost = min(SECONDS, self._cost / parts)
        most_cells = min(MOST_CELLS, self._cells / parts)
        batch: list[Job] = []
        cost, cells = 0.0, 0
        while self._jobs and (
            # At least one job; without expected costs the number of cells ends the batch.
            not batch or (cells < most_cells and (cost < most_cost or cost == 0.0))
        ):
            job = self._jobs.select_job(worker)
            batch.append(job)
            cost += self._cost_of(job)
            cells += len(job.cells)
        self._cost -= cost
        self._cells -= cells
        return tuple(batch)

    def _cost_of(self, job: Job) -> float:
        return sum(self._seconds.get(cell["id"], 0.0) for cell in job.cells)


TOLERANCE: Final = 1e-9
"""Relative difference of a row's numbers between machines; last bits differ with AVX-512."""
_MOST_TRIES: Final = 2
_IN_FLIGHT: Final = 2
"""Batches at the engine for each of its threads: one is computed, one is there when it ends."""

OnAnswer = Callable[[BatchAnswer | BaseException], None]


class _Engine(Protocol):
    """Engine as this module needs it: workers that compute, and a way to send batches there."""

    def submit(self, batch: Batch, worker: str, on_answer: OnAnswer) -> None:
        """Send a batch, to be computed by a worker or, where that is gone or busy, by another;
        `on_answer` gets its answer or the error of the engine, in any thread."""
        ...

    def workers(self) -> Mapping[str, int]:
        """Return the threads of each worker that computes now."""
        ...

    def is_lost(self) -> str:
        """Return why the engine will answer no more; "" where it may."""
        ...

    def cancel(self) -> None:
        """Forget all batches that were sent."""
        ...


_Thread = tuple[str, int]
"""Worker and number of one of its threads."""


@dataclass(frozen=True)
class _Sent:
    jobs: tuple[Job, ...]
    thread: _Thread
    tries: int


@dataclass(eq=False)
class ExecutorRun:
    """One run of jobs on an engine. `code` is the hash that workers must have ("" for any)."""

    engine: _Engine
    work: Work
    on_event: OnEvent
    code: str
    _owed: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    _again: deque[tuple[Job, int]] = field(default_factory=deque)  # job, tries
    _in_flight: Counter[_Thread] = field(default_factory=Counter)  # batches
    _machines: dict[str, Row] = field(default_factory=dict)  # id -> a row that it computed
    _notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        # Dask keeps results in the memory of its workers: finished ones can die with them.
        self._owed.update({cell["id"]: cell for _, cell in _cells(self.work.jobs)})
        self._waiting = BatchQueue(self.work.jobs, self.work.seconds)
        self._inbox: queue.SimpleQueue[tuple[_Sent, BatchAnswer | BaseException] | None]
        self._inbox = queue.SimpleQueue()
        self._interrupted = threading.Event()
        self._failed = False
        self._seat: BatchWorker | None = None
        self._limits = replace(self.work.settings, folder=Path(), keep_open=())

    def run(self) -> RunEnd:
        """Send batches and write the rows of their answers until none is owed."""
        folder = self.work.settings.folder
        with on_interrupt(self._interrupt), supervise.write_errors(folder):
            ending: Ending = "interrupted"
            try:
                with RowWriter(new_row_file(folder / "cells", "engine")) as writer:
                    ending = self._loop(writer)
            finally:
                if ending != "finished":
                    self.engine.cancel()
            if ending == "finished":
                self._compare_machines()
        return RunEnd(ending, tuple(self._notes))

    def _interrupt(self) -> None:
        self._interrupted.set()
        self._inbox.put(None)
        if self._seat is not None:
            self._seat.interrupt()

    def _loop(self, writer: RowWriter) -> Ending:
        while self._is_open():
            # Send batches until each thread of the engine has enough of them, the idle ones first
            workers = self.engine.workers()
            threads = [(name, k) for name, number in workers.items() for k in range(number)]
            # One batch for every thread before the second for any: nobody waits while others queue.
            for depth in range(_IN_FLIGHT):
                for thread in threads:
                    if self._in_flight[thread] <= depth and (self._again or self._waiting):
                        self._send_batch(thread, parts=_IN_FLIGHT * len(threads))
            for sent, answer in self._answers():
                self._in_flight[sent.thread] -= 1
                self._take(sent, answer, writer)
            ending = self._early_end()
            if ending is not None:
                return ending
        return "finished"

    def _is_open(self) -> bool:
        return bool(self._waiting or self._again or self._in_flight.total())

    def _early_end(self) -> Ending | None:
        """Reason for an end before all is done; None while the work goes on."""
        if self._interrupted.is_set():
            return "interrupted"
        if self._failed and self.work.fail_fast:
            return "stopped"
        if self._is_open() and (reason := self.engine.is_lost()):
            self._notes.append(f"{reason} Run again: only cells without a row run.")
            return "lost"
        return None

    def _send_batch(self, thread: _Thread, parts: int) -> None:
        if self._again:
            job, tries = self._again.popleft()
            sent = _Sent((job,), thread, tries)
        else:
            sent = _Sent(self._waiting.select_batch(thread, parts), thread, 0)
        self._in_flight[thread] += 1
        self.on_event("start", {"worker": "engine", "cells": _ids(sent.jobs)})
        batch = Batch(sent.jobs, self._limits, self.code)
        # An answer may come in any thread: the inbox brings it to the one that writes.
        self.engine.submit(batch, thread[0], lambda answer: self._inbox.put((sent, answer)))

    def _answers(self) -> Iterable[tuple[_Sent, BatchAnswer | BaseException]]:
        """Wait for an answer, half a second at most, and return all that have arrived."""
        found = []
        with contextlib.suppress(queue.Empty):
            found.append(self._inbox.get(timeout=0.5))
            while True:
                found.append(self._inbox.get_nowait())
        return [item for item in found if item is not None]

    def _take(self, sent: _Sent, answer: BatchAnswer | BaseException, writer: RowWriter) -> None:
        if isinstance(answer, BaseException):
            self._try_again(sent, f"{type(answer).__name__}: {answer}"[:300], writer)
            return
        if answer.refusal:
            raise UsageError(
                f"A worker does not compute for this run: {answer.refusal}. Install the same "
                "versions there, or accept rows of others with '?other-code' behind the address."
            )
        self._write_artifacts(answer.files or {})
        for row in answer.rows:
            self._write(row, writer)
        if answer.machine is not None and answer.rows:
            name = answer.machine["id"]
            if name not in self._machines:
                self._machines[name] = {}
                self.on_event("machine", answer.machine)
            if not self._machines[name]:  # a row to compare
                sound = (row for row in answer.rows if row.get("status") == "ok")
                self._machines[name] = next(sound, {})
        self.on_event("task", {"worker": "engine", "cells": _ids(sent.jobs)})

    def _write_artifacts(self, files: Mapping[str, bytes]) -> None:
        folder = (self.work.settings.folder / "artifacts").resolve()
        for name, data in files.items():
            path = (folder / name).resolve()
            if path.is_relative_to(folder):  # of no other place, whatever a plug-in wrote there
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)

    def _try_again(self, sent: _Sent, reason: str, writer: RowWriter) -> None:
        """Send the jobs of a batch that the engine lost again, one by one; after that they are
        `lost`."""
        # A lost scheduler takes all batches with it: no try of theirs counts.
        if self.engine.is_lost():
            self._again.extend((job, sent.tries) for job in sent.jobs)
        # One by one: a job that kills its machine does not take the others of its batch with it.
        elif sent.tries < _MOST_TRIES:
            self._again.extend((job, sent.tries + 1) for job in sent.jobs)
        else:
            for _, cell in _cells(sent.jobs):
                self._write(
                    supervise.row_of_end(cell, "lost", f"the engine lost it ({reason})"), writer
                )

    def _write(self, row: Row, writer: RowWriter) -> None:
        # A batch that was sent again may be answered twice.
        if self._owed.pop(row["id"], None) is None:
            return
        writer.write(row)
        self._failed |= row.get("status") in FAILURES
        self.on_event("row", {key: row.get(key) for key in ("id", "status", "reason")})

    def _compare_machines(self) -> None:
        """Compute one cell of each other machine here, and report where it differs."""
        here = environment_fields()["id"]
        others = {name: row for name, row in self._machines.items() if row and name != here}
        if not others:
            return
        seat = self._seat = BatchWorker(self._limits)
        try:
            for name, row in others.items():
                pairs = _cells(self.work.jobs)
                job = next(job.of({row["id"]: c}) for job, c in pairs if c["id"] == row["id"])
                (ours,) = seat.answer([job]).rows
                differing = _differing_fields(row, ours)
                if differing:
                    self._notes.append(
                        f"Machine {name} computes cell {row['id']} otherwise than this one by more "
                        f"than {TOLERANCE:g}: {', '.join(differing[:5])}; see env.json for its "
                        "processor and libraries."
                    )
        except KeyboardInterrupt:
            self._notes.append("Interrupted before every other machine was compared with this one.")
        finally:
            self._seat = None
            seat.close()


def _differing_fields(row: Row, ours: Row) -> list[str]:
    """Fields in which the rows of two machines differ, but for those of the machines."""
    compared = (key for key in row if key not in {*MACHINE_FIELDS, "machine"})
    return [key for key in compared if not _agrees(row[key], ours.get(key))]


def _agrees(a: Any, b: Any) -> bool:
    """True for equal values, numbers up to the tolerance."""
    if isinstance(a, float) and isinstance(b, float | int):
        are_nan = math.isnan(a) and math.isnan(b)
        return are_nan or math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=1e-12)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_agrees(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_agrees, a, b))
    return bool(a == b)


def _cells(jobs: Iterable[Job]) -> Iterator[tuple[Job, Mapping[str, Any]]]:
    """Yield each job with each of its cells."""
    return ((job, cell) for job in jobs for cell in job.cells)


def _ids(jobs: Iterable[Job]) -> list[str]:
    return [cell["id"] for _, cell in _cells(jobs)]
