"""Cells of the conformance kit of executors: each does what its name asks for, then has a row."""

import os
import signal
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from sysid_bench.experiments.job_channel import JobChannel


def _hang() -> None:
    time.sleep(1000)


def _crash() -> None:
    os.kill(os.getpid(), getattr(signal, "SIGSEGV", signal.SIGTERM))


def _raise() -> None:
    raise ArithmeticError("asked for")


ACTS: Final[Mapping[str, Callable[[], None]]] = MappingProxyType(
    {"hangs": _hang, "crashes": _crash, "raises": _raise}
)
"""What a cell "NAME.ACT" does before it would have a row."""

STATUS: Final[Mapping[str, str]] = MappingProxyType(
    {"hangs": "timeout", "crashes": "crash", "raises": "failed"}
)
"""Status of the row of such a cell."""


def run_cells(argument: Mapping[str, Any], channel: JobChannel) -> None:
    """Write a row for each asked cell, with the sum of numbers drawn from `argument`["seed"]."""
    for cell in argument["cells"]:
        if cell not in channel.cells:
            continue
        channel.start_cell(cell)
        ACTS.get(cell.partition(".")[2], lambda: None)()
        drawn = np.random.default_rng([argument["seed"], *cell.encode()]).normal(size=50)
        channel.write({"id": cell, "status": "ok", "sum": float(drawn.sum())})
