"""Common parts of log readers: libraries of the extra `logs`, imported where a file needs
them, errors of libraries as one sentence, and the progress of reading long files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

from sysid_bench.errors import UsageError, reason_of
from sysid_bench.extras import extra_module

Listener = Callable[[Path, float], None]
"""(recorded file, share of it that has been read)."""

_LISTENER: Final[ContextVar[Listener | None]] = ContextVar("read_progress", default=None)


def log_library(module: str, path: Path) -> Any:
    """Return a module that reads a file; raises UsageError with the command that installs it."""
    return extra_module(module, str(path))


@contextmanager
def library_errors(path: Path, kind: str) -> Iterator[None]:
    """Turn what a library raises on a damaged file of a `kind` ("an HDF5 file that can be read"),
    of many types, into UsageError."""
    try:
        yield
    except UsageError:
        raise
    except MemoryError as error:
        raise UsageError(
            f"{path} states more data than memory holds: it is damaged or too large; write it "
            "again, or in parts."
        ) from error
    except Exception as error:
        raise UsageError(f"{path} is not {kind}: {reason_of(error)}.") from error


@contextmanager
def report_to(listener: Listener) -> Iterator[None]:
    """Let a listener hear of the progress of the readers called inside."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def report(path: Path, done: int, total: int) -> None:
    """Report `done` of `total` bytes, rows or messages of a file."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(path, min(done / max(total, 1), 1.0))
