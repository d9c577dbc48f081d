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
from collections.abc import Callable, Iterator
from typing import Any, Final

from sysid_bench.errors import reason_of, status_of
from sysid_bench.experiments.job_channel import ProcessEnd
from sysid_bench.harness.work.process_tree import kill_subtree, kill_with
from sysid_bench.words import STATUSES

Message = dict[str, Any]
Send = Callable[[Message], None]
CAN_FORK: Final = sys.platform == "linux"
"""Not on macOS, whose frameworks do not survive a fork and which ends no fork with its parent."""
_GRACE_SECONDS = 2.0
_LONGEST = 1 << 26
"""Bytes of a message; a plug-in that writes more without a line end is not heard any more."""
_POLL_MILLISECONDS = 200
"""Interval of the check for a dead process whose pipe one of its children keeps open."""


def run_process(
    function: Callable[[Send], Any], receive: Callable[[Message], None]
) -> ProcessEnd | None:
    """Fork, run `function(send)` in the child and hand its messages to `receive` in the parent.

    Return None where the function has returned, else its end: an exception is `failed` (or
    `memory`, `lost`), the death of the process `crash`, its SIGKILL from outside `lost`.
    """
    try:
        child, pipe = _start_child(function)
    except OSError as error:  # no process or descriptor is left on this machine
        return ProcessEnd("lost", f"its process could not be started ({reason_of(error)})")
    last: Message | None = None
    killed = True
    try:
        for message in _messages(pipe, child):
            if "end" in message:
                last = message
                break
            receive(message)
        killed = last is None and not _ends_by_itself(child)
    finally:
        os.close(pipe)
        # Nothing of the child, and of what it has started, is left behind.
        if not _has_ended(child):
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        # Until here the child was a zombie, so that no other process could have its number.
        _, state = os.waitpid(child, 0)
        kill_subtree()
    if last is not None:
        match last["end"]:
            case None:
                return None
            # Third-party code can write into this pipe: what is not an end of ours is its fault.
            case [str(status), str(reason), str(text)] if status in STATUSES:
                return ProcessEnd(status, reason, text)
        return ProcessEnd("crash", "its process wrote into the pipe of its result")
    if killed:
        return ProcessEnd("crash", "its process closed the pipe of its result")
    return ProcessEnd(*end_of_process(os.waitstatus_to_exitcode(state)))


def end_of_process(code: int) -> tuple[str, str]:
    """Status and sentence of a process that ended by itself, from its (negative signal) code."""
    if code >= 0:
        return "crash", f"its process ended with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    # SIGKILL comes from outside (a user, the memory of the machine): not the method's failure, and
    # the cell is tried again.
    status = "lost" if name == "SIGKILL" else "crash"
    return status, f"its process was killed by {name}"


def _start_child(function: Callable[[Send], Any]) -> tuple[int, int]:
    """Fork; return the process that runs the function, and the end of its pipe to read."""
    parent = os.getpid()
    read_end, write_end = os.pipe()
    try:
        with warnings.catch_warnings():
            # The other thread of a worker waits for its input and holds no lock that a child takes.
            warnings.simplefilter("ignore", DeprecationWarning)
            # A fork has the prepared experiment and the engines, each of which is imported for half
            # a second. It keeps faults in, and no cheat out: the truth is in its memory.
            child = os.fork()
    except OSError:
        os.close(read_end)
        os.close(write_end)
        raise
    if child == 0:
        os.close(read_end)
        _run_child(function, write_end, parent)
    os.close(write_end)
    return child, read_end


def _run_child(function: Callable[[Send], Any], pipe: int, parent: int) -> None:
    """Run the function, send its end and leave; the process never returns from here."""
    process = os.getpid()
    os.setsid()  # it may end its process group, and not the worker with it
    kill_with(parent)
    # Close what the parent has open (row file, notices, lock), except the standard streams.
    # Close-on-exec does not act at a fork, and an orphan would hold the lock of the run.
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        if descriptor > 2 and descriptor != pipe:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def send(message: Message) -> None:
        if os.getpid() != process:  # a fork of the function came back from it: not our result
            os._exit(1)
        data = json.dumps(message).encode() + b"\n"
        while data:
            data = data[os.write(pipe, data) :]

    try:
        try:
            function(send)
            end = None
        except BaseException as error:
            end = (status_of(error), reason_of(error), traceback.format_exc())
        with contextlib.suppress(Exception):
            sys.stderr.flush()
        send({"end": end})
    except BaseException:  # closed descriptors: the parent sees a process without an end
        os._exit(1)
    finally:
        # Not sys.exit(): exit hooks and buffers that the fork inherited are its parent's.
        os._exit(0)


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
            try:
                message = json.loads(line)
            except (ValueError, RecursionError):  # a plug-in may write to any descriptor
                continue
            if isinstance(message, dict) and message:
                yield message
        if len(rest) > _LONGEST:
            return


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
