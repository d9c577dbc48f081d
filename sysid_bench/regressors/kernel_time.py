"""CPU time that the regressor kernels of this process took: what a regression of speed looks at."""

import threading
import time
from dataclasses import dataclass, field
from typing import Final


@dataclass
class _Spent:
    seconds: float = 0.0
    lock: threading.Lock = field(default_factory=threading.Lock)


_SPENT: Final = _Spent()


def count_kernel(start: float) -> None:
    """Add the CPU time of the calling thread since `start`, of `time.thread_time()`."""
    with _SPENT.lock:
        _SPENT.seconds += time.thread_time() - start


def kernel_times() -> float:
    """CPU time (s) of the kernels in this process so far."""
    return _SPENT.seconds
