"""The viewer of recordings, a program of its own."""

import os
import subprocess
import sys
from pathlib import Path

from sysid_bench.errors import UsageError
from sysid_bench.extras import missing


def view(path: Path, web: bool = False) -> subprocess.Popen[bytes]:
    """Open the viewer on this machine alone; the process is the caller's to wait for.

    Raises UsageError where the recording or the viewer is absent.
    """
    if not path.is_file():
        raise UsageError(
            f"The recording {str(path)!r} does not exist; make it with sysid-bench record."
        )
    screen = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform == "linux" and not web and not any(map(os.environ.get, screen)):
        raise UsageError(
            "The viewer needs a display, and this session has none (DISPLAY, WAYLAND_DISPLAY); "
            "--web shows the recording in a browser."
        )
    more = ["--web-viewer"] if web else []
    # Bound to this machine: the viewer would else listen on every network.
    return subprocess.Popen([str(rerun_tool()), "--bind", "127.0.0.1", *more, str(path)])


def rerun_tool() -> Path:
    """The `rerun` program that belongs to this Python."""
    folder = Path(sys.executable).parent
    # Beside this Python and not by PATH, where a viewer of another version may lie.
    for name in ("rerun", "rerun.exe", "Scripts/rerun.exe"):
        if (folder / name).is_file():
            return folder / name
    raise missing("rerun", f"The viewer, a program next to {sys.executable!r},")
