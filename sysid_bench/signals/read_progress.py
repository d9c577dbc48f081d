"""Progress of the reading of long recordings, for a listener that a command line sets."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Final

Listener = Callable[[Path, float], None]
"""(recorded file, share of it that has been read)."""

_LISTENER: Final[ContextVar[Listener | None]] = ContextVar("read_progress", default=None)


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
