"""Lock of a folder against other runners, which ends with the last process that holds it."""

import contextlib
import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sysid_bench.errors import UsageError
from sysid_bench.input_files import is_file

try:
    import fcntl
except ImportError:  # Windows has no flock: two runners on one folder are not detected there
    fcntl = None  # type: ignore[assignment]

ORPHAN_SECONDS = 10.0
"""Time for the workers of a killed runner to end; they hold its lock until then."""
_PROC = Path("/proc")


@contextmanager
def folder_lock(folder: Path) -> Iterator[int | None]:
    """Lock a folder against other runners; yield the descriptor that workers inherit.

    The lock ends with the last process that holds it: workers of a killed runner keep it until
    they have ended, so that they add no row after the next run has read the rows. Raises UsageError
    where another runner holds it.
    """
    if fcntl is None:
        yield None
        return
    # flock and not a file that is there or not: the kernel takes it from processes that are killed.
    path = folder / ".lock"
    if os.path.lexists(path) and not is_file(path):
        raise UsageError(f"{str(path)!r} is not a file, so that it cannot lock; remove it.")
    # Without O_TRUNC: until the lock is ours, the file names its present holder.
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _acquire(path, descriptor)
        try:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, str(os.getpid()).encode(), 0)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EIO):  # a link to a file of /proc
                raise
            raise UsageError(f"{str(path)!r} cannot lock ({error.strerror}); remove it.") from error
        yield descriptor
    finally:
        # Closed, not unlocked: LOCK_UN would take the lock from workers that inherited it.
        os.close(descriptor)


def _acquire(path: Path, descriptor: int) -> None:
    until = time.monotonic() + ORPHAN_SECONDS
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            holder = os.pread(descriptor, 20, 0).decode(errors="replace")
            # The holder is dead, yet the lock is held: by its workers, which are about to end.
            if _is_alive(holder) or time.monotonic() > until:
                ours = f"process {os.getpid()} "
                others = [text for text in process_lines(path) if ours not in text]
                # The number in the file, where the processes of others are not seen.
                shown = " and ".join(others[:3]) or f"process {holder or 'unknown'}"
                raise UsageError(
                    f"Another runner, {shown}, is running in {str(path.parent)!r}; wait for it, "
                    "stop it, or choose another -o."
                ) from error
        time.sleep(0.02)


def _is_alive(process: str) -> bool:
    if not process.isdigit():
        return False
    try:
        # Signal 0 only asks. "Not permitted" means that another user's process has the number.
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        # A zombie holds no lock, and its number is not given to another process.
        return (_PROC / process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (OSError, IndexError):
        return True


def process_lines(path: Path) -> list[str]:
    """Return "process 12 (its command line)" for each process that has a file open."""
    found, wanted = list[str](), os.path.realpath(path)
    for entry in _PROC.iterdir() if _PROC.is_dir() else ():
        with contextlib.suppress(OSError):  # another user's, or ended since
            if entry.name.isdigit() and wanted in map(os.path.realpath, (entry / "fd").iterdir()):
                words = (entry / "cmdline").read_bytes().rstrip(b"\0").split(b"\0")
                command = " ".join(word.decode(errors="replace") for word in words)
                found.append(f"process {entry.name} ({command[:100]})")
    return found
