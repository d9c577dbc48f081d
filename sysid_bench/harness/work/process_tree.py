"""Process trees on Linux: descendants are found and ended, whatever groups or sessions they chose.

Elsewhere (no /proc) process groups alone are ended, by the callers.
"""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, NoReturn

MARK: Final = "SYSID_BENCH_WORKER"
"""Environment variable of a worker and all that inherits from it; its value names the worker."""

_PROC = Path("/proc")
_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_SET_CHILD_SUBREAPER = 36
_PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
_ROUNDS = 20
"""Rounds of killing: a process that forks while it is being killed needs more than one."""
_KILL_SECONDS = 10.0
"""Time of killing: processes that fork faster than they are killed, or that the kernel holds."""


_KILL: Final = getattr(signal, "SIGKILL", signal.SIGTERM)  # Windows has no SIGKILL


def kill_with(parent: int, at_its_end: int = _KILL) -> None:
    """Let Linux kill this process with its parent, also while compiled code runs; its orphaned
    descendants become its children."""
    if sys.platform != "linux":
        return
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    # Tied to the thread that started this process: it has to live as long as the process is wanted.
    _prctl(_PR_SET_PDEATHSIG, at_its_end)
    if os.getppid() != parent:  # it ended before the call
        os._exit(1)


def start_process(parent: int, close: Callable[[], None]) -> None:
    """Go on in a fork of this process, on Linux; this process stays, as the guard of the fork.

    When the fork or `parent` ends, however it does, the guard ends all that the fork has started,
    in whatever session, and then itself as the fork did. `close` closes the pipes of the guard.
    """
    if sys.platform != "linux":
        return
    # An ignored SIGCHLD, which is inherited, would take away exit codes of children.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    ends = {signal.SIGCHLD, signal.SIGTERM}
    # Blocked before the fork, so that an end that comes at once waits for sigwait.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ends | {signal.SIGINT, signal.SIGHUP})
    kill_with(parent, signal.SIGTERM)
    guard = os.getpid()
    # The guard is the parent: a worker that is killed could not clean up behind itself, while its
    # parent, as a subreaper, gets all that it leaves.
    fork = os.fork()
    if fork == 0:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        kill_with(guard)
        return
    close()
    codes = dict[int, int]()
    # SIGTERM ends the wait as well: from the supervisor, or from the kernel when it is gone.
    while fork not in codes and signal.sigwait(ends) == signal.SIGCHLD:
        with contextlib.suppress(ChildProcessError):
            # Pending signals of one kind are one: a SIGCHLD may stand for several children.
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                codes[ended[0]] = os.waitstatus_to_exitcode(ended[1])
    codes |= kill_subtree()
    end_as(codes.get(fork, 1))


def end_as(code: int) -> NoReturn:
    """End this process with an exit code, or by the signal of a negative one, without a core."""
    if code < 0:
        _prctl(_PR_SET_DUMPABLE, 0)
        with contextlib.suppress(OSError, ValueError):  # SIGKILL has no handler
            signal.signal(-code, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {-code})
        os.kill(os.getpid(), -code)
    os._exit(code & 0xFF)


def _prctl(option: int, value: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(option, value)


def kill_subtree() -> dict[int, int]:
    """End all descendants of this process, as a subreaper also those that their parents left.

    Return the (negative signal) code of each that became its child.
    """
    codes = dict[int, int]()
    until = time.monotonic() + _KILL_SECONDS
    while (below := tree_of(os.getpid())) and time.monotonic() < until:
        kill(below)
        for child in _children_of(os.getpid()):
            with contextlib.suppress(ChildProcessError):
                codes[child] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return codes


def kill_tree(mark: str, also: Iterable[int] = ()) -> None:
    """End every process whose environment has this mark, and the processes `also`."""
    kill(also)
    # By environment, since it stays where a process changed its group, session and parent.
    wanted = f"{MARK}={mark}".encode()
    for _ in range(_ROUNDS):
        found = list[int]()
        for entry in _PROC.iterdir() if _PROC.is_dir() else ():
            if entry.name.isdigit() and int(entry.name) != os.getpid():
                with contextlib.suppress(OSError):  # zombies have no environment any more
                    if wanted in (entry / "environ").read_bytes().split(b"\0"):
                        found.append(int(entry.name))
        if not found:
            return
        kill(found)


def kill(processes: Iterable[int]) -> None:
    """Send SIGKILL; processes that have ended are passed over."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(process, _KILL)


def kill_group(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process that leads a group, and that group where the system has groups."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, _KILL)
        else:
            process.kill()


def tree_of(process: int) -> list[int]:
    """Return the processes below one, without itself."""
    found, waiting = list[int](), _children_of(process)
    while waiting:
        child = waiting.pop()
        found.append(child)
        waiting += _children_of(child)
    return found


def child_of(process: int) -> int:
    """Return the first child of a process; the process itself where it has none."""
    return min(_children_of(process), default=process)


def _children_of(process: int) -> list[int]:
    """Return the children of all threads of a process; none where it has ended."""
    found = list[int]()
    with contextlib.suppress(OSError):
        for thread in (_PROC / str(process) / "task").iterdir():
            with contextlib.suppress(OSError):
                found += map(int, (thread / "children").read_text().split())
    return found


def memory_use(process: int, enough: float) -> float:
    """Return the memory of a process tree in bytes; exactly only where it may be over `enough`.

    Resident pages that a fork shares are counted in each process, which is quick and too much; the
    proportional figures of the kernel, which are slow, count them once.
    """
    tree = [process, *tree_of(process)]
    resident = proportional = 0
    for one in tree:
        with contextlib.suppress(OSError, ValueError, IndexError):  # it has ended
            resident += _PAGE * int((_PROC / str(one) / "statm").read_text().split()[1])
    if resident <= enough:
        return resident
    for one in tree:
        with contextlib.suppress(OSError, ValueError, IndexError):
            text = (_PROC / str(one) / "smaps_rollup").read_text()
            proportional += 1024 * int(text.partition("\nPss:")[2].split()[0])
    return proportional
