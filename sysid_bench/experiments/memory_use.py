"""Use of the machine by one cell: load of the processors and peak memory, fields of its row."""

import contextlib
import os
from pathlib import Path

from sysid_bench.types import Row

_STATUS = Path("/proc/self/status")
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
        if self._known:
            with contextlib.suppress(OSError, ValueError, IndexError):
                peak = _STATUS.read_text().partition("\nVmHWM:")[2].split()[0]
                return int(peak) * 1024 / 1e6
        return None


def usage_fields(peak: MemoryUse | None) -> Row:
    """`load` (mean number of busy processes over a minute) and `peak_memory` (MB) of a cell."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"load": load, "peak_memory": None if peak is None else peak.value}
