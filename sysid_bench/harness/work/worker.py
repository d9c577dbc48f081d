"""Worker process, `python -m sysid_bench.harness.work.worker`, with JSON lines in both directions.

In: settings {parent, path, rows}, then jobs {call, argument, cells}; null ends the worker.
Out: {begin}, {row: id, status, reason}, and {done} or {failed: reason, traceback}.
A row is stored before it is announced, so that it survives the supervisor. The worker ends at once
when its input ends.
"""

import contextlib
import ctypes
import faulthandler
import importlib
import json
import os
import queue
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.harness.work.row_files import RowWriter
from sysid_bench.types import Row

Notify = Callable[[dict[str, Any]], None]


def main() -> None:
    """Run jobs until the input ends."""
    jobs_in, notices_out = _take_pipes()
    faulthandler.enable(all_threads=False)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    settings = json.loads(jobs_in.readline() or b"null")
    if settings is None:
        return
    _end_with_parent(settings["parent"])
    threading.Thread(target=_listen, args=(jobs_in, inbox), daemon=True).start()
    sys.path[:] = list(dict.fromkeys([*settings["path"], *sys.path]))
    with RowWriter(Path(settings["rows"])) as writer:
        while True:
            job = json.loads(inbox.get())
            if job is None:
                writer.close()
                os._exit(0)  # exit hooks of libraries may hang
            _run(job, writer, _notifier(notices_out))


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


def _end_with_parent(parent: int) -> None:
    """Let Linux kill this process with its parent, also while compiled code keeps _listen from
    running."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            pr_set_pdeathsig = 1
            ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
            if os.getppid() != parent:  # it ended before the call
                os._exit(1)


def _listen(jobs_in: BinaryIO, inbox: "queue.SimpleQueue[bytes]") -> None:
    for line in jobs_in:
        inbox.put(line)
    os._exit(1)


def _notifier(notices_out: BinaryIO) -> Notify:
    def notify(notice: dict[str, Any]) -> None:
        try:
            notices_out.write(json.dumps(notice).encode() + b"\n")
            notices_out.flush()
        except OSError:  # the supervisor has ended
            os._exit(1)

    return notify


def _run(job: Mapping[str, Any], writer: RowWriter, notify: Notify) -> None:
    open_cells = set(job["cells"])

    def emit(row: Row) -> None:
        if row.get("id") not in open_cells:
            raise UsageError(
                f"{job['call']} emitted a row for {row.get('id')!r}; the cells of this job are "
                f"{', '.join(sorted(open_cells))}."
            )
        writer.append(row)
        notify({"row": row["id"], "status": row.get("status"), "reason": row.get("reason")})

    try:
        function = _function(job["call"])
        notify({"begin": True})
        function(job["argument"], emit)
    except BaseException as error:  # sys.exit() of a plug-in fails its job, and no more
        notify({"failed": reason_of(error), "traceback": traceback.format_exc()})
    else:
        notify({"done": True})


def _function(call: str) -> Callable[[Any, Callable[[Row], None]], None]:
    module, _, name = call.partition(":")
    found: Callable[[Any, Callable[[Row], None]], None] = getattr(
        importlib.import_module(module), name
    )
    return found


if __name__ == "__main__":
    main()
