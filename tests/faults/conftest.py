"""Suites and tasks of the tests of the harness serve here too."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "harness"))
sys.path.insert(0, str(Path(__file__).parent))


def left_behind(token: str) -> list[str]:
    """Processes of this test but itself: by their environment, or by their arguments."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and int(process.name) != os.getpid():
            try:
                known = (process / "environ").read_bytes() + (process / "cmdline").read_bytes()
            except OSError:
                continue
            if token.encode() in known:
                found.append((process / "cmdline").read_bytes().decode())
    return found


def wait_for(true: Callable[[], object], seconds: float = 60.0) -> bool:
    """Wait until something is true, at most this long."""
    until = time.monotonic() + seconds
    while not true():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


@pytest.fixture
def token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A word in the environment of every process that a test starts."""
    monkeypatch.setenv("SYSID_TEST_FAULT", tmp_path.name)
    return tmp_path.name
