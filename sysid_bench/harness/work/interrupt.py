"""SIGTERM and SIGHUP as Ctrl-C: apart, since every command imports it before it knows its work."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


def default_interrupt() -> None:
    """Do what Ctrl-C does in Python."""
    raise KeyboardInterrupt


@contextmanager
def on_interrupt(act: Callable[[], None]) -> Iterator[None]:
    """Call `act` for SIGINT, SIGTERM and SIGHUP; Python lets the main thread alone set handlers.

    Signals that this process ignores, as SIGHUP under nohup, stay ignored, and so do those that it
    ignores by the end (`without_interrupt`).
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        act()

    handlers = {number: signal.getsignal(number) for number in _numbers()}
    before = {number: h for number, h in handlers.items() if h is not signal.SIG_IGN}
    try:
        for number in before:
            signal.signal(number, handle)
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is handle:  # no other has been set since
                with contextlib.suppress(TypeError):  # None: not set from Python
                    signal.signal(number, handler)


def without_interrupt() -> None:
    """Ignore further signals: an interrupted process is on its way out, with its own exit code."""
    if threading.current_thread() is threading.main_thread():
        for number in _numbers():
            signal.signal(number, signal.SIG_IGN)


def _numbers() -> Iterator[int]:
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        if hasattr(signal, name):
            yield getattr(signal, name)
