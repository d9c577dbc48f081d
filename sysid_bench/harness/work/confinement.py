"""Confinement of this process on Linux: without the other processes, the network and some files.

A method that is scored shares its user with the processes that hold the truth. In namespaces of
its own it sees no other process (no `/proc/PID/mem`, no `process_vm_readv`), has no network, can
write to its folder alone, which is in memory and of the namespace alone, and the files that are
hidden from it are empty; it cannot leave, having no capability there. Of devices it has those that
every user may open, of the keys of the kernel none. Where the system refuses namespaces, what
remains is a process without privileges (`PROCESS`).
"""

import contextlib
import ctypes
import errno
import os
import signal
import stat
import struct
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NoReturn

from sysid_bench.errors import UsageError
from sysid_bench.harness.work.process_tree import MARK, end_as, kill_with
from sysid_bench.words import NAMESPACES, PROCESS

ISOLATION: Final = "SYSID_BENCH_ISOLATION"
"""Environment variable: `process` runs methods without namespaces, as where the system has none."""

_INHERITED: Final = (
    "PATH", "PYTHONPATH", "VIRTUAL_ENV", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "SYSTEMROOT",
    "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS",
    "SYSID_BENCH_KERNEL", MARK,
)  # fmt: skip
"""Variables of the environment that a method inherits: no file of seeds, no token of the user."""

_NEW_MOUNTS, _NEW_IPC, _NEW_USER = 0x00020000, 0x08000000, 0x10000000
_NEW_PROCESSES, _NEW_NETWORK = 0x20000000, 0x40000000
_BIND, _RECURSIVE, _PRIVATE = 0x1000, 0x4000, 0x40000
_READ_ONLY, _NO_DEVICES = 0x1, 0x2 | 0x4
_NO_DEVICES_OR_PROGRAMS: Final = _NO_DEVICES | 0x8
_PR_SET_DUMPABLE, _PR_CAPBSET_DROP, _PR_SET_NO_NEW_PRIVS = 4, 24, 38
_MOUNT_SETATTR, _RECURSIVE_AT = 442, 0x8000
_ATTRIBUTE_READ_ONLY, _ATTRIBUTE_NO_DEVICES = 0x1, 0x4
_EVERY_USER: Final = stat.S_IROTH | stat.S_IWOTH
_DESCRIPTORS: Final = 256
"""More than a process has that was just started."""
_CAPABILITIES: Final = 64
_CAPABILITY_VERSION: Final = 0x20080522
_SHARED: Final = "/dev/shm"
"""Memory that processes share by name: empty, and of the namespace alone."""


def wanted_isolation() -> str:
    """Return the isolation that ISOLATION names; raises UsageError for another word."""
    wanted = os.environ.get(ISOLATION) or NAMESPACES
    if wanted not in (NAMESPACES, PROCESS):
        raise UsageError(f"{ISOLATION} is {wanted!r}; give {NAMESPACES} or {PROCESS}.")
    return wanted


def method_environment(folder: str, environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the variables of an environment that a process with third-party code inherits; its
    temporary and home folder is `folder`, the only one that it can write to."""
    kept = {key: environment[key] for key in _INHERITED if key in environment}
    return {**kept, "TMPDIR": folder, "HOME": folder}


def confine(
    folder: str, hidden: Iterable[str], wanted: str = NAMESPACES, *, private: bool = False
) -> str:
    """Go on in a confined process, which can write to `folder` alone and to which the paths
    `hidden` are empty; return its isolation. What it writes to a `private` folder nobody else sees.

    With namespaces this process stays, as the parent of the confined one, and ends as that ends,
    with all that it has started.
    """
    if sys.platform != "linux":
        return PROCESS
    kill_with(os.getppid())
    libc = ctypes.CDLL(None, use_errno=True)
    isolation = PROCESS
    paths = tuple(filter(os.path.exists, {*hidden, *_sockets(), "/dev/pts"}))
    if wanted == NAMESPACES and _can_enter(libc, folder, paths, private):
        _enter_namespaces(libc, folder, paths, private)
        _fork_inside(libc)
        isolation = NAMESPACES
    _drop_capabilities(libc)
    _leave_keyring(libc)
    _count_all_children(libc)
    _hide_page_cache(libc)
    return isolation


def _sockets() -> Iterator[str]:
    """Yield the sockets in files: they lead out of every namespace, to programs as tmux, docker and
    systemd that start others."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
            yield line[max(0, line.find("/")) :]
    # Those of the host, which a container may be given in /run, are of another network namespace.
    with contextlib.suppress(OSError), os.scandir("/run") as entries:
        yield from (one.path for one in entries if one.name.endswith(".sock"))


def hide_memory(hidden: bool) -> None:
    """Keep other processes of this user, unless they are root with its capabilities, from reading
    the memory and the environment of this one, or allow it again."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0 if hidden else 1)


def _can_enter(libc: ctypes.CDLL, folder: str, hidden: Sequence[str], private: bool) -> bool:
    """True where the system allows all of `_enter_namespaces`."""
    # In a fork: some systems give a namespace without its privileges, and there is no way back.
    trial = os.fork()
    if trial == 0:
        try:
            _enter_namespaces(libc, folder, hidden, private)
        except BaseException:
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(trial, 0)[1]) == 0


def _enter_namespaces(libc: ctypes.CDLL, folder: str, hidden: Sequence[str], private: bool) -> None:
    """Enter namespaces of users, mounts, processes (for children), network and messages; raise
    OSError where the system refuses."""
    user, group = os.getuid(), os.getgid()
    kinds = _NEW_USER | _NEW_MOUNTS | _NEW_PROCESSES | _NEW_NETWORK | _NEW_IPC
    if libc.unshare(kinds) != 0:
        raise OSError(ctypes.get_errno(), "unshare")
    # Files belong to the same user and group as before.
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
    Path("/proc/self/gid_map").write_text(f"{group} {group} 1")
    _mount(libc, None, "/", None, _RECURSIVE | _PRIVATE)
    for path in hidden:
        if os.path.isdir(path):
            _mount(libc, "none", path, "tmpfs", _NO_DEVICES_OR_PROGRAMS)
            continue
        with contextlib.suppress(FileNotFoundError):  # a socket that is gone
            _mount(libc, "/dev/null", path, None, _BIND)
    own = [path for path in (_SHARED,) if os.path.isdir(path)]
    for path in own:
        _mount(libc, "none", path, "tmpfs", _NO_DEVICES_OR_PROGRAMS, "size=1g")
    if private:
        _mount(libc, "none", folder, "tmpfs", _NO_DEVICES, "size=1g")
    else:
        _mount(libc, folder, folder, None, _BIND)
    # Of the devices, which read-only mounts do not close, those that every user may open: root, and
    # members of a group, could read the disk below the files.
    devices = []
    with os.scandir("/dev") as entries:
        for path, mode in ((one.path, one.stat(follow_symlinks=False).st_mode) for one in entries):
            if stat.S_ISCHR(mode) and mode & _EVERY_USER == _EVERY_USER:
                with contextlib.suppress(OSError):
                    _mount(libc, path, path, None, _BIND)
                    devices.append(path)
    _set_mounts(libc, "/", add=_ATTRIBUTE_READ_ONLY | _ATTRIBUTE_NO_DEVICES)
    for path in (folder, *own):
        _set_mounts(libc, path, remove=_ATTRIBUTE_READ_ONLY)
    for path in devices:
        with contextlib.suppress(OSError):  # where the system allows no devices at all
            _set_mounts(libc, path, remove=_ATTRIBUTE_NO_DEVICES)
    os.chdir(folder)  # that of the new mount


def _set_mounts(libc: ctypes.CDLL, path: str, *, add: int = 0, remove: int = 0) -> None:
    """Set or clear attributes of all mounts at and below a path (mount_setattr, Linux 5.12)."""
    attributes = (ctypes.c_uint64 * 4)(add, remove, 0, 0)
    at = ctypes.c_char_p(os.fsencode(path))
    if libc.syscall(_MOUNT_SETATTR, -1, at, _RECURSIVE_AT, attributes, ctypes.c_size_t(32)) != 0:
        raise OSError(ctypes.get_errno(), f"mount_setattr of {path}")


def _mount(
    libc: ctypes.CDLL,
    source: str | None,
    target: str,
    kind: str | None,
    flags: int,
    data: str | None = None,
) -> None:
    texts = [None if text is None else os.fsencode(text) for text in (source, target, kind, data)]
    if libc.mount(*texts[:3], ctypes.c_ulong(flags), texts[3]) != 0:
        raise OSError(ctypes.get_errno(), f"mount of {target}")


def _fork_inside(libc: ctypes.CDLL) -> None:
    """Return in a grandchild, the second process of the namespace; its parent is the first one,
    with which the kernel ends all others."""
    status_in, status_out = os.pipe()
    first = os.fork()
    if first:
        os.close(status_out)
        _end_like(status_in, first)
    kill_with(os.getppid())
    os.close(status_in)
    try:
        # Read-only: root may set what the kernel runs outside, as for a core dump (/proc/sys).
        _mount(libc, "proc", "/proc", "proc", _NO_DEVICES_OR_PROGRAMS | _READ_ONLY)
    except OSError:  # containers may refuse: then there is no /proc
        _mount(libc, "none", "/proc", "tmpfs", _NO_DEVICES_OR_PROGRAMS)
    # The first process of a namespace ignores signals, its own as well: methods run in another one.
    second = os.fork()
    if second == 0:
        os.close(status_out)
        os.setsid()
        return
    _close_pipes(keep=status_out)
    ended, status = 0, 0
    while ended != second:
        ended, status = os.wait()
    os.write(status_out, status.to_bytes(4, "little"))
    os._exit(0)


def _end_like(status_in: int, first: int) -> NoReturn:
    """Wait for the namespace and end this process as its method has ended: with its exit code, or
    by its signal; without a status, SIGKILL came from outside."""
    _close_pipes(keep=status_in)
    data = os.read(status_in, 4)
    os.waitpid(first, 0)
    status = int.from_bytes(data, "little") if len(data) == 4 else int(signal.SIGKILL)
    end_as(os.waitstatus_to_exitcode(status))


def _close_pipes(keep: int) -> None:
    """Leave the pipes to the method: they end with it."""
    # Not by /proc/self/fd: /proc may be that of the namespace already.
    for low, high in ((0, 2), (3, keep), (keep + 1, _DESCRIPTORS)):
        os.closerange(low, high)


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    """Give up all privileges for ever, also those that root, or a program, would have again."""
    for capability in range(_CAPABILITIES):
        libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    libc.capset(header, (ctypes.c_uint32 * 6)())
    libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)


_CALLS: Final[dict[str, tuple[int, int, int, int]]] = {
    "x86_64": (0xC000003E, 13, 250, 317),
    "aarch64": (0xC00000B7, 134, 219, 277),
    "riscv64": (0xC00000F3, 134, 219, 277),
}
"""Number of an architecture, and of its calls rt_sigaction, keyctl and seccomp."""


def _leave_keyring(libc: ctypes.CDLL) -> None:
    """Join an empty session keyring: processes inherit that of the user's session, in which a
    method could leave data for those behind it."""
    if (known := _CALLS.get(os.uname().machine)) is not None:
        libc.syscall(known[2], 1, None)


def _count_all_children(libc: ctypes.CDLL) -> None:
    """Ignore changes of how SIGCHLD is handled, by a filter of system calls (seccomp): the kernel
    adds the time of a child to nobody's where its parent ignores the signal."""
    known = _CALLS.get(os.uname().machine)
    if known is None or sys.byteorder != "little":
        return
    machine, action, _, seccomp = known
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    # Jumps are relative; of seccomp_data: 0 number, 4 architecture, 16 and 24 arguments.
    load, equal, above, answer = 0x20, 0x15, 0x35, 0x06
    allow, done, unknown = 0x7FFF0000, 0x00050000, 0x00050000 | errno.ENOSYS
    program = [
        (load, 0, 0, 4), (equal, 0, 11, machine), (load, 0, 0, 0), (above, 9, 0, 0x40000000),
        (equal, 0, 6, action), (load, 0, 0, 16), (equal, 0, 4, int(signal.SIGCHLD)),
        (load, 0, 0, 24), (equal, 0, 3, 0), (load, 0, 0, 28), (equal, 0, 1, 0),
        (answer, 0, 0, allow), (answer, 0, 0, done), (answer, 0, 0, unknown),
    ]  # fmt: skip
    _filter_calls(libc, seccomp, program)


_PAGE_CACHE: Final[dict[str, tuple[int, ...]]] = {
    "x86_64": (27, 221, 327, 451),
    "aarch64": (232, 223, 286, 451),
    "riscv64": (232, 223, 286, 451),
}
"""Numbers of mincore, fadvise64, preadv2 and cachestat."""


def _hide_page_cache(libc: ctypes.CDLL) -> None:
    """Answer ENOSYS to calls that tell which pages of a file are in memory, or drop them: files
    that all may read would else carry a note from one method to the next."""
    machine = os.uname().machine
    if machine not in _PAGE_CACHE or sys.byteorder != "little":
        return
    calls = _PAGE_CACHE[machine]
    load, equal, answer = 0x20, 0x15, 0x06
    # Jumps are relative: from call i over the other calls and the line that allows.
    refused = [(equal, len(calls) - i, 0, call) for i, call in enumerate(calls)]
    program = [
        (load, 0, 0, 0), *refused, (answer, 0, 0, 0x7FFF0000),
        (answer, 0, 0, 0x00050000 | errno.ENOSYS),
    ]  # fmt: skip
    _filter_calls(libc, _CALLS[machine][3], program)


def _filter_calls(
    libc: ctypes.CDLL, seccomp: int, program: Sequence[tuple[int, int, int, int]]
) -> None:
    code = b"".join(struct.pack("=HBBI", *line) for line in program)
    buffer = ctypes.create_string_buffer(code)
    # Without SECCOMP_FILTER_FLAG_SPEC_ALLOW (4) older kernels slow the process down.
    libc.syscall(seccomp, 1, 4, struct.pack("@HP", len(program), ctypes.addressof(buffer)))
