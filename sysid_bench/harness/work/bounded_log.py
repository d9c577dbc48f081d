"""Log file of bounded size: the beginning of an output, and its end."""

import contextlib
from pathlib import Path
from typing import Final

LIMIT: Final = 1 << 20
"""Bytes of output that a log file takes; a full file is kept as `*.old.log`."""
_TAIL: Final = 1 << 16


class BoundedLog:
    """Output of one worker: at most `LIMIT` bytes of its beginning, and its last 64 kB."""

    def __init__(self, path: Path) -> None:
        if path.exists() and path.stat().st_size >= LIMIT:
            path.replace(path.with_suffix(".old.log"))
        self._file = path.open("ab", buffering=0)
        self._room = LIMIT - self._file.tell()
        self._left_out = 0
        self._tail = b""
        self.total = 0

    def write(self, data: bytes) -> None:
        """Take output; a full disk loses it, and nothing else."""
        kept = data[: self._room]
        self._store(kept)
        self._room -= len(kept)
        self._left_out += len(data) - len(kept)
        self._tail = (self._tail + data)[-_TAIL:]
        self.total += len(data)

    def output(self, start: int) -> str:
        """Return the output after its first `start` bytes, the last 64 kB at most."""
        length = min(self.total - start, len(self._tail))
        return self._tail[len(self._tail) - length :].decode(errors="replace")

    def close(self) -> None:
        """Write the end of an output that had no room."""
        if self._file.closed:
            return
        end = self._tail[max(0, len(self._tail) - self._left_out) :]
        if end:
            left_out = self._left_out - len(end)
            self._store(f"\n[{left_out} bytes of output are left out]\n".encode() + end)
        self._file.close()

    def _store(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._file.write(data)
