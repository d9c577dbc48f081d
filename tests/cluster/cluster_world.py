"""A Dask scheduler and its workers as processes of this machine, and a suite for them."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sysid_bench.harness.work.row_files import read_rows
from sysid_bench.models.manifest import find_manifest
from sysid_bench.words import MACHINE_FIELDS

HOUSEKEEPING = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}
"""Dask without its profiler, as docs/clusters.md advises: its processes share the cores here."""
ARM = "example-robot-data:double_pendulum_description/urdf/double_pendulum_continuous.urdf"
ROOT = Path(__file__).parents[2]
SUITE = """
schema = 1
name   = "far"
[run]
repeats = 8
timeout = "20 s"
[defaults]
excitation = { use = "fourier", period = "2 s", cycles = 1 }
held_out   = [["fourier-other"]]
rate       = "50 Hz"
noise      = { tau = "1 %" }
signals    = { filter = "none", derivatives = "exact" }
[[robot]]
use = ["file:arm.urdf", "scara"]
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
[[estimator]]
use = "file:mine.py:Mine"
[[metric]]
use = "file:mine.py:visited"
"""
MINE = """
import os
import time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from sysid_bench.types import Estimate, Metric
@dataclass(frozen=True)
class Mine:
    def solve(self, problem):
        return Estimate(beta=np.zeros(problem.base.rank))
# Methods run blind, without this environment; metrics belong to the suite.
def visit(cell):
    time.sleep(float(os.environ.get("PAUSE", "0.1")))
    if "NODE_LOGS" in os.environ:
        wait_for_two_nodes(Path(os.environ["NODE_LOGS"]))
    return 0.0
visited = Metric("visited", "Visited", compute=visit)
def wait_for_two_nodes(folder):
    log = folder / os.environ["SLURMD_NODENAME"]
    is_first, deadline = not log.exists(), time.monotonic() + 15.0
    log.touch()
    while is_first and len(list(folder.iterdir())) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
"""
UNRULY = """
import os, signal, time
from dataclasses import dataclass
@dataclass(frozen=True)
class Hangs:
    def solve(self, problem):
        time.sleep(1000)
@dataclass(frozen=True)
class Crashes:
    def solve(self, problem):
        os.kill(os.getpid(), signal.SIGSEGV)
"""


def write_suite(folder: Path, more: str = "", **replaced: str) -> Path:
    """A folder with a suite, a robot and plug-ins, all of which have to travel."""
    folder.mkdir(parents=True, exist_ok=True)
    found = find_manifest(ARM).path
    (folder / "arm.urdf").write_text(found.read_text())
    (folder / "mine.py").write_text(MINE)
    (folder / "unruly.py").write_text(UNRULY)
    text = SUITE
    for old, new in replaced.items():
        text = text.replace(old, new)
    (folder / "far.toml").write_text(text + more)
    return folder / "far.toml"


def free_port() -> int:
    """A port of this machine that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Cluster:
    """A scheduler on a free port of this machine."""

    folder: Path
    port: int = 0
    processes: list["subprocess.Popen[bytes]"] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.port = free_port()
        self.scheduler = self._start(
            "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port),
            "--no-dashboard",
        )  # fmt: skip

    @property
    def address(self) -> str:
        return f"dask://127.0.0.1:{self.port}?patience=20s"

    def join(
        self, path: Path = ROOT, python: str = sys.executable, pause: float = 0.1
    ) -> "subprocess.Popen[bytes]":
        """A worker with one thread, whose code is in this folder; `pause` (s) of each third-party
        cell."""
        return self._start(
            "distributed.cli.dask_worker", f"127.0.0.1:{self.port}", "--nthreads", "1",
            "--no-nanny", "--no-dashboard", "--local-directory", str(self.folder / "dask"),
            path=path, python=python, pause=pause,
        )  # fmt: skip

    def wait_for_workers(self, number: int) -> None:
        """Wait until so many workers have joined."""
        address = f"127.0.0.1:{self.port}"
        code = f"import distributed as d; d.Client({address!r}).wait_for_workers({number}, 60)"
        subprocess.run([sys.executable, "-c", code], check=True)

    def _start(
        self,
        module: str,
        *words: str,
        path: Path = ROOT,
        python: str = sys.executable,
        pause: float = 0.1,
    ) -> "subprocess.Popen[bytes]":
        with (self.folder / f"{len(self.processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [python, "-m", module, *words], stdout=log, stderr=log, cwd=self.folder,
                env={**os.environ, **HOUSEKEEPING, "PYTHONPATH": str(path), "PAUSE": str(pause)},
            )  # fmt: skip
        self.processes.append(process)
        return process

    def close(self) -> None:
        for process in reversed(self.processes):
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()


def bench(*words: str) -> "subprocess.Popen[str]":
    """`sysid-bench` with these words, as a process."""
    return subprocess.Popen(
        [sys.executable, "-m", "sysid_bench", *words], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def run_on(executor: str, suite: Path, out: Path) -> "subprocess.Popen[str]":
    """A run of a suite on an executor, as a process."""
    return bench("run", str(suite), "-o", str(out), "--executor", executor)


def done(process: "subprocess.Popen[str]", code: int = 0) -> str:
    """All output of a process that ends with this exit code."""
    out, err = process.communicate(timeout=240)
    assert process.returncode == code, out + err
    return out + err


def rows(folder: Path) -> dict[str, Any]:
    """Rows of a run without what differs between machines."""
    stored = read_rows(folder / "cells").rows
    return {
        name: {key: value for key, value in row.items() if key not in MACHINE_FIELDS}
        for name, row in stored.items()
    }


def wait_for_rows(folder: Path, number: int, seconds: float = 120.0) -> None:
    """Wait until a run has stored so many rows."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if (folder / "cells").is_dir() and len(read_rows(folder / "cells").rows) >= number:
            return
        time.sleep(0.05)
    raise AssertionError(f"{folder} has less than {number} rows after {seconds:g} s.")


def seats() -> list[str]:
    """Command lines of worker processes whose parent is gone."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
            if b"sysid_bench.harness.work.worker" in words and parent == "1":
                found.append(entry.name)
    return found


def kill(process: "subprocess.Popen[Any]") -> None:
    """Kill a process as a machine's end does, and close its pipes."""
    process.send_signal(signal.SIGKILL)
    process.wait()
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
