"""CPU time that the regressor kernels of this process took: what a regression of speed looks at."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final


@dataclass
class _Spent:
    seconds: float = 0.0
    lock: threading.Lock = field(default_factory=threading.Lock)


_SPENT: Final = _Spent()


@contextmanager
def kernel_timed() -> Iterator[None]:
    """Count the CPU time of the calling thread as that of a kernel."""
    start = time.thread_time()
    try:
        yield
    finally:
        spent = time.thread_time() - start
        with _SPENT.lock:
            _SPENT.seconds += spent


def kernel_seconds() -> float:
    """CPU time (s) of the kernels in this process so far."""
    return _SPENT.seconds
