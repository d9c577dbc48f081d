"""Run of a function in a forked process, whose messages come back through a pipe.

Third-party code runs here: it may replace functions, leak, crash, fork or close descriptors, and
the forking process, with its prepared experiment, stays as it was.
"""

import contextlib
import json
import os
import select
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from sysid_bench.errors import reason_of, status_of
from sysid_bench.experiments.job_channel import Death
from sysid_bench.harness.work.processes import kill_children, with_parent

Message = dict[str, Any]
Send = Callable[[Message], None]
CAN_FORK: Final = hasattr(os, "fork") and hasattr(select, "poll")
_GRACE_SECONDS = 2.0
_POLL_MILLISECONDS = 200
"""Interval of the check for a dead process whose pipe one of its children keeps open."""


def isolate(function: Callable[[Send], Any], receive: Callable[[Message], None]) -> Death | None:
    """Fork, run `function(send)` in the child and hand its messages to `receive` in the parent.

    Return None where the function has returned, else its end: an exception is `failed` (or
    `memory`, `lost`), the death of the process `crash`, its SIGKILL from outside `lost`.
    """
    read_end, write_end = os.pipe()
    child = _fork()
    if child == 0:
        os.close(read_end)
        _run_child(function, write_end)
    os.close(write_end)
    last: Message | None = None
    killed = True
    try:
        for message in _messages(read_end, child):
            if "end" in message:
                last = message
                break
            receive(message)
        killed = last is None and not _ends_by_itself(child)
    finally:
        os.close(read_end)
        state = _end_child(child)
    if last is None and killed:
        return Death("crash", "its process closed the pipe of its result")
    if last is None:
        return Death(*end_of_process(os.waitstatus_to_exitcode(state)))
    return None if last["end"] is None else Death(*last["end"])


def end_of_process(code: int) -> tuple[str, str]:
    """Status and sentence of a process that ended by itself, from its (negative signal) code."""
    if code >= 0:
        return "crash", f"its process ended with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    status = "lost" if name == "SIGKILL" else "crash"
    return status, f"its process was killed by {name}"


def _fork() -> int:
    with warnings.catch_warnings():
        # The other thread of a worker waits for its input and holds no lock that a child takes.
        warnings.simplefilter("ignore", DeprecationWarning)
        return os.fork()


def _run_child(function: Callable[[Send], Any], pipe: int) -> None:
    """Run the function, send its end and leave; the process never returns from here."""
    process = os.getpid()
    with_parent(os.getppid())
    _close_others(pipe)

    def send(message: Message) -> None:
        if os.getpid() != process:  # a fork of the function came back from it: not our result
            os._exit(1)
        data = json.dumps(message).encode() + b"\n"
        while data:
            data = data[os.write(pipe, data) :]

    try:
        _send_end(function, send)
    except BaseException:  # closed descriptors: the parent sees a process without an end
        os._exit(1)
    finally:
        os._exit(0)


def _close_others(kept: int) -> None:
    """Close what the parent has open (row file, notices, lock), except the standard streams."""
    open_now = os.listdir("/proc/self/fd") if sys.platform == "linux" else ()
    for descriptor in map(int, open_now):
        if descriptor > 2 and descriptor != kept:
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _send_end(function: Callable[[Send], Any], send: Send) -> None:
    try:
        function(send)
        end = None
    except BaseException as error:
        end = (status_of(error), reason_of(error), traceback.format_exc())
    with contextlib.suppress(Exception):
        sys.stderr.flush()
    send({"end": end})


def _messages(pipe: int, child: int) -> Iterator[Message]:
    """Yield the messages of a child until its pipe ends or the child is dead."""
    poll = select.poll()
    poll.register(pipe, select.POLLIN | select.POLLHUP)
    rest = b""
    while True:
        alive = not _has_ended(child)
        if poll.poll(_POLL_MILLISECONDS if alive else 0):
            data = os.read(pipe, 1 << 16)
        elif alive:
            continue
        else:
            return
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            with contextlib.suppress(ValueError):  # bytes of a plug-in that wrote to any descriptor
                message = json.loads(line)
                if isinstance(message, Mapping):
                    yield dict(message)


def _has_ended(child: int) -> bool:
    """True for a dead child; it stays a zombie, so that its exit status is still there."""
    flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
    return os.waitid(os.P_PID, child, flags) is not None


def _ends_by_itself(child: int) -> bool:
    """Wait for the end of a child whose pipe is closed, as that of a dying process is first."""
    until = time.monotonic() + _GRACE_SECONDS
    while not _has_ended(child):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def _end_child(child: int) -> int:
    """Kill what is left of the child and of all that it has started; return its wait status."""
    if not _has_ended(child):
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    _, state = os.waitpid(child, 0)
    kill_children()
    return state
