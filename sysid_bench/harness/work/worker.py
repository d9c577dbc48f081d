"""The process that runs tasks: `python -m sysid_bench.harness.work.worker`, JSON lines both ways.

In: a greeting {parent, path, rows}, then tasks {call, argument, cells}.
Out: {begin}, {row: id, status, reason}, and {done} or {failed: reason, traceback}.
A row is stored before it is told, so that it outlives the
supervisor. The worker outlives nobody: when its input ends, it ends, in the middle of anything.
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
from pathlib import Path
from typing import Any, BinaryIO

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.harness.work.row_files import RowWriter
from sysid_bench.types import Row

Tell = Callable[[dict[str, Any]], None]


def main() -> None:
    """Runs tasks until the input ends."""
    tasks_in, notices_out = _take_pipes()
    faulthandler.enable(all_threads=False)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    greeting = json.loads(tasks_in.readline() or b"null")
    if greeting is None:
        return
    _die_with(greeting["parent"])
    threading.Thread(target=_listen, args=(tasks_in, inbox), daemon=True).start()
    sys.path[:] = list(dict.fromkeys([*greeting["path"], *sys.path]))
    with RowWriter(Path(greeting["rows"])) as writer:
        while True:
            task = json.loads(inbox.get())
            if task is None:  # a farewell: nothing of ours is left to do, and no exit hook may hang
                writer.close()
                os._exit(0)
            _run(task, writer, _teller(notices_out))


def _take_pipes() -> tuple[BinaryIO, BinaryIO]:
    """The protocol moves to descriptors of its own: prints go to the log, input() finds nothing."""
    tasks_in = os.fdopen(os.dup(0), "rb")
    notices_out = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return tasks_in, notices_out


def _die_with(parent: int) -> None:
    """Linux kills this process with its parent, even where the watching thread cannot run."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            import ctypes
            import signal

            pr_set_pdeathsig = 1
            ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
            if os.getppid() != parent:  # it died before we asked
                os._exit(1)


def _listen(tasks_in: BinaryIO, inbox: "queue.SimpleQueue[bytes]") -> None:
    for line in tasks_in:
        inbox.put(line)
    os._exit(1)


def _teller(notices_out: BinaryIO) -> Tell:
    def tell(notice: dict[str, Any]) -> None:
        try:
            notices_out.write(json.dumps(notice).encode() + b"\n")
            notices_out.flush()
        except OSError:  # nobody listens any more
            os._exit(1)

    return tell


def _run(task: Mapping[str, Any], writer: RowWriter, tell: Tell) -> None:
    open_cells = set(task["cells"])

    def emit(row: Row) -> None:
        if row.get("id") not in open_cells:
            raise UsageError(
                f"{task['call']} emitted a row for {row.get('id')!r}; it was asked for "
                f"{', '.join(sorted(open_cells))}."
            )
        writer.append(row)
        tell({"row": row["id"], "status": row.get("status"), "reason": row.get("reason")})

    try:
        function = _function(task["call"])
        tell({"begin": True})
        function(task["argument"], emit)
    except BaseException as error:  # sys.exit() of a plug-in is its failure, not our end
        tell({"failed": reason_of(error), "traceback": traceback.format_exc()})
    else:
        tell({"done": True})


def _function(call: str) -> Callable[[Any, Callable[[Row], None]], None]:
    module, _, name = call.partition(":")
    found: Callable[[Any, Callable[[Row], None]], None] = getattr(
        importlib.import_module(module), name
    )
    return found


if __name__ == "__main__":
    main()
