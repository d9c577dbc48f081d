"""Consolidation of a run while it goes on, in a process of its own: python -m
sysid_bench.harness.run_frames FOLDER PARENT."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.harness.stored_run import FEW_BYTES, RunFolder
from sysid_bench.harness.work.process_tree import kill_with
from sysid_bench.harness.work.row_files import row_files
from sysid_bench.harness.work.supervise import OnEvent
from sysid_bench.harness.work.worker_process import worker_environment

_LOOK_SECONDS: Final = 1.0
_GROWTH: Final = 1.5
"""Growth of the row files between two consolidations: each takes what the earlier one holds, but
writes all of it again."""


@contextmanager
def frames_of_run(
    folder: RunFolder, keep_open: tuple[int, ...], on_event: OnEvent
) -> Iterator[OnEvent]:
    """Yield `on_event` for a run that is consolidated as it grows; wait for the last time at its
    end.

    The process inherits the descriptors `keep_open`, and ends with this one.
    """
    growth = _Growth(folder.path, keep_open)

    def act(kind: str, data: Mapping[str, Any]) -> None:
        on_event(kind, data)
        if kind == "task":
            growth.update()

    try:
        yield act
        growth.wait()
    finally:
        growth.kill()


@dataclass(eq=False)
class _Growth:
    folder: Path
    keep_open: tuple[int, ...]

    def __post_init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._due = self._bytes() + FEW_BYTES
        self._next_look = 0.0

    def _bytes(self) -> int:
        return sum(path.stat().st_size for path in row_files(self.folder / "cells"))

    def update(self) -> None:
        """Start a consolidation where it is due and none goes on."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + _LOOK_SECONDS
        is_busy = self._process is not None and self._process.poll() is None
        if not is_busy and (size := self._bytes()) > self._due:
            self._due = int(_GROWTH * size) + FEW_BYTES
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, str(self.folder), str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=worker_environment(1),
                pass_fds=self.keep_open,
                start_new_session=True,  # Ctrl-C reaches the supervisor alone
            )

    def wait(self) -> None:
        if self._process is not None:
            self._process.wait()

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def main(folder: str, parent: str) -> None:
    """Consolidate the rows stored so far; what fails here is reported at the end of the run."""
    kill_with(int(parent))
    if hasattr(os, "nice"):
        os.nice(10)
    RunFolder(Path(folder)).write_frames()


if __name__ == "__main__":
    main(*sys.argv[1:])
