"""Process trees on Linux: descendants are found and ended, whatever groups or sessions they chose.

Elsewhere (no /proc) process groups alone are ended, by the callers.
"""

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

MARK: Final = "SYSID_BENCH_WORKER"
"""Environment variable of a worker and all that inherits from it; its value names the worker."""

_PROC = Path("/proc")
_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
_ROUNDS = 20
"""Rounds of killing: a process that forks while it is being killed needs more than one."""


def with_parent(parent: int) -> None:
    """Let Linux kill this process with its parent, also while compiled code runs; its orphaned
    descendants become its children."""
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before the call
            os._exit(1)


def kill_children() -> None:
    """End all children of this process, and what they leave behind to a subreaper."""
    for _ in range(_ROUNDS):
        children = children_of(os.getpid())
        if not children:
            return
        kill(children)
        for child in children:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(child, 0)


def kill_tree(mark: str, also: Iterable[int] = ()) -> None:
    """End every process whose environment has this mark, and the processes `also`."""
    kill(also)
    for _ in range(_ROUNDS):
        found = _marked(mark)
        if not found:
            return
        kill(found)


def kill(processes: Iterable[int]) -> None:
    """Send SIGKILL; processes that have ended are passed over."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(process, signal.SIGKILL)


def tree_of(process: int) -> list[int]:
    """Return the processes below one, without itself."""
    found, waiting = list[int](), children_of(process)
    while waiting:
        child = waiting.pop()
        found.append(child)
        waiting += children_of(child)
    return found


def children_of(process: int) -> list[int]:
    """Return the children of all threads of a process; none where it has ended."""
    found = list[int]()
    with contextlib.suppress(OSError):
        for thread in (_PROC / str(process) / "task").iterdir():
            with contextlib.suppress(OSError):
                found += map(int, (thread / "children").read_text().split())
    return found


def processes_with(path: Path) -> list[str]:
    """Return "process 12 (its command line)" for each process that has a file open."""
    found = list[str]()
    for entry in _PROC.iterdir() if _PROC.is_dir() else ():
        if entry.name.isdigit() and _has_open(entry, os.path.realpath(path)):
            words = (entry / "cmdline").read_bytes().rstrip(b"\0").split(b"\0")
            command = " ".join(word.decode(errors="replace") for word in words)
            found.append(f"process {entry.name} ({command[:100]})")
    return found


def _has_open(process: Path, path: str) -> bool:
    with contextlib.suppress(OSError):
        for descriptor in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                if os.readlink(descriptor) == path:
                    return True
    return False


def memory_use(process: int, enough: float) -> float:
    """Return the memory of a process tree in bytes; exactly only where it may be over `enough`.

    Resident pages that a fork shares are counted in each process, which is quick and too much; the
    proportional figures of the kernel, which are slow, count them once.
    """
    tree = [process, *tree_of(process)]
    resident = sum(map(_resident_bytes, tree))
    return resident if resident <= enough else sum(map(_proportional_bytes, tree))


def _resident_bytes(process: int) -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        return _PAGE * int((_PROC / str(process) / "statm").read_text().split()[1])
    return 0


def _proportional_bytes(process: int) -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = (_PROC / str(process) / "smaps_rollup").read_text()
        return 1024 * int(text.partition("\nPss:")[2].split()[0])
    return 0


def _marked(mark: str) -> list[int]:
    """Return the living processes with this mark; zombies have no environment any more."""
    wanted = f"{MARK}={mark}".encode()
    found = list[int]()
    for entry in _PROC.iterdir() if _PROC.is_dir() else ():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if wanted in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
    return found
