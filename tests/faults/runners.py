"""Runners that tests kill, what they leave behind, and waiting for it."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def suite_of(methods: Iterable[str], defaults: str = "", robot: str = 'use = "scara"') -> str:
    """A suite of one short experiment; `methods`: the keys of each [[estimator]]."""
    head = f"""
        schema = 1
        name = "one"
        [defaults]
        excitation = {{ use = "fourier", harmonics = 3, period = "2 s" }}
        held_out = ["ptp"]
        {defaults}
        [[robot]]
        {robot}
        """
    return head + "".join(f"[[estimator]]\n{keys}\n" for keys in methods)


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


def start(suite: Path, out: Path, jobs: int) -> "subprocess.Popen[str]":
    path = os.pathsep.join([str(HERE.parent / "harness"), str(HERE.parents[1])])
    return subprocess.Popen(
        [sys.executable, str(HERE / "kill_runner.py"), str(suite), str(out), str(jobs)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def stored_lines(cells: Path) -> list[dict[str, Any]]:
    lines = [line for file in cells.glob("*.jsonl") for line in file.read_text().split("\n")]
    return [json.loads(line) for line in lines if line.endswith("}")]
