"""Worker process, `python -m sysid_bench.harness.work.worker`, with JSON lines in both directions.

In: settings {parent, path, rows, memory, confined}, then jobs {number, call, argument, cells,
losses}; null ends the worker. Out, each with the number of its job: {begin}, {cell: id} before a
cell, {row: id, status, reason}, {progress: value}, and at the end {done: value},
{failed: reason, status, traceback}, {dead: reason, status}, or {full: reason} where a row cannot be
stored; with {left: true} third-party code has run in this process, which ends then. A row is stored
before it is announced, so that it survives the supervisor. The worker ends at once when its input
ends. On Linux it is the fork of a guard, which leaves nothing of it behind (see process_tree.py).
"""

import contextlib
import faulthandler
import importlib
import json
import os
import queue
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from sysid_bench.canonical_json import plain
from sysid_bench.errors import UsageError, reason_of, status_of
from sysid_bench.experiments.job_channel import JobChannel, JobEnd, Method, ProcessEnd
from sysid_bench.harness.work.blind_process import blind_method
from sysid_bench.harness.work.confinement import confine
from sysid_bench.harness.work.process_tree import start_process
from sysid_bench.harness.work.row_files import RowWriter
from sysid_bench.harness.work.run_process import CAN_FORK, Message, Send, run_process
from sysid_bench.types import Row
from sysid_bench.words import LABELS

try:
    import resource
except ImportError:  # Windows; the supervisor alone watches the memory of its workers there
    resource = None  # type: ignore[assignment]

Function = Callable[[Any, JobChannel], Any]


class _StorageError(Exception):
    """A row that the file system does not take."""


class _Left(BaseException):
    """End of a job in a process that third-party code may have changed; `death`: its end before a
    row."""

    def __init__(self, death: ProcessEnd | None) -> None:
        super().__init__()
        self.death = death


def main() -> None:
    """Run jobs until the input ends."""
    # Before anything else: what an import prints would be read as a notice.
    jobs_in, notices_out = _take_pipes()
    # A crash in compiled code leaves a line in the log, which the supervisor takes as its reason.
    faulthandler.enable(all_threads=False)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    settings = json.loads(jobs_in.readline() or b"null")
    if settings is None:
        return
    # Before the first thread: a fork goes on with the calling thread alone.
    start_process(settings["parent"], partial(_close_pipes, jobs_in, notices_out))
    if settings.get("confined"):
        confine(*settings["confined"])
    if settings["memory"] is not None and resource is not None:
        # Allocations beyond the limit raise MemoryError, in this process and its forks.
        limit = int(settings["memory"])
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))

    def listen() -> None:
        for line in jobs_in:
            inbox.put(line)
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    # Plug-ins are found as in the process that planned their cells.
    sys.path[:] = list(dict.fromkeys([*settings["path"], *sys.path]))
    with RowWriter(Path(settings["rows"])) as writer:
        while True:
            job = json.loads(inbox.get())
            if job is None:
                writer.close()
                os._exit(0)  # exit hooks of libraries may hang
            if not _run(job, writer, _notifier(notices_out, job["number"])):
                writer.close()
                os._exit(0)


def _take_pipes() -> tuple[BinaryIO, BinaryIO]:
    """Move the protocol to descriptors of its own: prints go to the log, input() reads nothing."""
    jobs_in = os.fdopen(os.dup(0), "rb")
    notices_out = os.fdopen(os.dup(1), "wb")
    null_device = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null_device, 0)
    os.close(null_device)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return jobs_in, notices_out


def _close_pipes(jobs_in: BinaryIO, notices_out: BinaryIO) -> None:
    """Leave the pipes to the worker: they end with it."""
    jobs_in.close()
    notices_out.close()
    null_device = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(null_device, stream)
    os.close(null_device)


def _notifier(notices_out: BinaryIO, number: int) -> Send:
    process = os.getpid()

    def notify(notice: Message) -> None:
        if os.getpid() != process:  # a fork that came back from a plug-in
            os._exit(1)
        try:
            notices_out.write(json.dumps({"job": number, **notice}).encode() + b"\n")
            notices_out.flush()
        except OSError:  # the supervisor has ended
            os._exit(1)

    return notify


def _run(job: Mapping[str, Any], writer: RowWriter, notify: Send) -> bool:
    """Run a job; return True where this process can take another one."""
    try:
        module, _, name = job["call"].partition(":")
        function: Function = getattr(importlib.import_module(module), name)
        # The module is imported: from here on the job's own time limit holds.
        notify({"begin": True})
        channel = _StoringChannel(
            job["call"], set(job["cells"]), writer.path.parents[1], job["losses"], writer, notify
        )
        value = function(job["argument"], channel)
    except _StorageError as error:
        notify({"full": reason_of(error.__cause__ or error)})
    except JobEnd as ended:
        notify({"dead": ended.death.reason, "status": ended.death.status})
    except _Left as left:
        death = left.death
        end = {} if death is None else {"dead": death.reason, "status": death.status}
        notify({"left": True, **end})
        return False
    except BaseException as error:  # sys.exit() of a plug-in fails its job, and nothing more
        text = traceback.format_exc()
        notify({"failed": reason_of(error), "status": status_of(error), "traceback": text})
    else:
        notify({"done": value})
    return True


@dataclass(frozen=True)
class _Channel:
    """Channel that accepts rows of the open cells of a job alone, and isolates functions."""

    call: str
    open_cells: set[str]
    run_folder: Path

    @property
    def cells(self) -> frozenset[str]:
        return frozenset(self.open_cells)

    def write(self, row: Row) -> None:
        """Store and announce a row. Raises UsageError for a cell that is not open, TypeError for
        values that are not JSON."""
        if row.get("id") not in self.open_cells:
            raise UsageError(
                f"{self.call} emitted a row for {row.get('id')!r}; the cells of this job are "
                f"{', '.join(sorted(self.open_cells))}."
            )
        self._store(row)
        self.open_cells.discard(row["id"])

    def blind_method(
        self, estimator: Mapping[str, Any], *, simulated: bool, sealed: bool
    ) -> AbstractContextManager[Method]:
        return blind_method(estimator, self.run_folder, simulated=simulated, sealed=sealed)

    def run_process(
        self, function: Callable[[JobChannel], Any], heads: Mapping[str, Row]
    ) -> ProcessEnd | None:
        if not CAN_FORK:  # in this process, which goes on with nothing else then
            try:
                function(self)
            except (_Left, _StorageError):
                raise
            except BaseException as error:
                death = ProcessEnd(status_of(error), reason_of(error), traceback.format_exc())
                raise _Left(death) from error
            raise _Left(None)
        cells = self.open_cells & heads.keys()

        def receive(message: Message) -> None:
            """Take a message of the fork as if it were a call; `heads` stay as they are, since
            third-party code may write anything into its pipe."""
            row = message.get("row")
            cell = row.get("id") if isinstance(row, dict) else message.get("cell")
            if not isinstance(cell, str) or cell not in self.open_cells & heads.keys():
                return  # forged: the child refuses it too
            if isinstance(row, dict):
                # First for the order of the fields, last for their values.
                self.write(heads[cell] | row | heads[cell])
            else:
                self.start_cell(cell)

        return run_process(
            lambda send: function(_ForkedChannel(self.call, cells, self.run_folder, send)), receive
        )

    def start_cell(self, cell: str) -> None:
        raise NotImplementedError

    def progress(self, value: Any) -> None:
        """Pass on a figure; a fork has nobody who listens."""

    def _store(self, row: Row) -> None:
        raise NotImplementedError


@dataclass(frozen=True)
class _StoringChannel(_Channel):
    """Channel of the worker itself: rows go to its file, notices to the supervisor."""

    losses: Mapping[str, int]
    writer: RowWriter
    notify: Send

    def start_cell(self, cell: str) -> None:
        self.notify({"cell": cell})

    def progress(self, value: Any) -> None:
        self.notify({"progress": value})

    def _store(self, row: Row) -> None:
        if row.get("status") == "lost":
            row = {**row, "losses": self.losses.get(row["id"], 0) + 1}
        try:
            try:
                self.writer.write(row)
            except UsageError as error:  # too large: its labels with the reason
                labels = ("id", "experiment", *LABELS, "repeat", "fingerprint")
                row = {key: row[key] for key in labels if key in row}
                row |= {"status": "failed", "reason": str(error)}
                self.writer.write(row)
        except OSError as error:
            raise _StorageError from error
        self.notify({"row": row["id"], "status": row.get("status"), "reason": row.get("reason")})


@dataclass(frozen=True)
class _ForkedChannel(_Channel):
    """Channel of a forked process, whose messages its parent passes on."""

    send: Send

    def start_cell(self, cell: str) -> None:
        self.send({"cell": cell})

    def _store(self, row: Row) -> None:
        self.send({"row": plain(row)})


if __name__ == "__main__":
    main()
