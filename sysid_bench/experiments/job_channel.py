"""Way of the results of a job to its supervisor, and the use of the machine by a cell."""

import contextlib
import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from sysid_bench.types import Row


@dataclass(frozen=True)
class ProcessEnd:
    """End of an isolated process without its result: `status` of the cell that it computed."""

    status: str
    reason: str
    traceback: str = ""

    @property
    def fields(self) -> Row:
        """The end as fields of a row."""
        row: Row = {"status": self.status, "reason": self.reason}
        return row | {"traceback": self.traceback} if self.traceback else row


class JobEnd(Exception):
    """A job whose isolated process ended before its cells had rows."""

    def __init__(self, death: ProcessEnd) -> None:
        super().__init__(death.reason)
        self.death = death


class MethodEnd(Exception):
    """A method whose process ended, or reported an error, before it had an estimate."""

    def __init__(self, end: ProcessEnd) -> None:
        super().__init__(end.reason)
        self.end = end


class Method(Protocol):
    """An estimator in a process of its own; see `JobChannel.blind_method`."""

    isolation: str
    sources: dict[str, str]

    @property
    def peak_memory(self) -> float | None:
        """Largest resident memory (MB) of its process."""


class JobChannel(Protocol):
    """Channel from a job to its supervisor."""

    @property
    def cells(self) -> frozenset[str]:
        """Ids of the cells to compute; others of the experiment have a row already."""

    def start_cell(self, cell: str) -> None:
        """Announce a cell: its time limit starts, and it answers for the end of the process."""

    def write(self, row: Row) -> None:
        """Store the row of a cell and announce it."""

    def progress(self, value: Any) -> None:
        """Pass a JSON value on to the caller of this job, while it goes on."""

    def blind_method(
        self, estimator: Mapping[str, Any], *, simulated: bool, sealed: bool
    ) -> AbstractContextManager[Method]:
        """A third-party estimator {use, settings} in a process of its own, started fresh, that
        never held the truth and ends with the context. Its calls raise MethodEnd; so does the start
        of one of a `sealed` plant without namespaces, before any code of the method runs."""

    def run_process(
        self, function: Callable[["JobChannel"], Any], heads: Mapping[str, Row]
    ) -> ProcessEnd | None:
        """Run a function in a process of its own, a fork of this one with all that is prepared.

        Its channel leads to this one. Nothing that it changes (modules, global state, descriptors)
        reaches this process, and no process that it started survives it. It answers for the cells
        of `heads` alone, by id, and these fields stand in their rows, whatever it sends. Return
        None after a complete run, else its end.
        """


_CLEAR = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"


class MemoryUse:
    """Largest resident memory of this process since the object was made; Linux alone has it."""

    def __init__(self) -> None:
        self._known = False
        with contextlib.suppress(OSError):
            _CLEAR.write_text(_RESET_PEAK)
            self._known = True

    @property
    def value(self) -> float | None:
        """Peak in MB (10^6 bytes), None where the system does not report it."""
        return peak_memory("self") if self._known else None


def peak_memory(process: int | str) -> float | None:
    """Largest resident memory (MB) of a process until now; None where it is not known."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        status = Path(f"/proc/{process}/status").read_text()
        return int(status.partition("\nVmHWM:")[2].split()[0]) * 1024 / 1e6
    return None


def usage_fields(peak: float | None) -> Row:
    """`load` (mean number of busy processes over a minute) and `peak_memory` (MB) of a cell."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"load": load, "peak_memory": peak}
