"""Runs on a platform that has no fork, no process groups, no /proc calls and no limits of memory:
the rows are those of this platform, and nothing goes on behind a run."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import sysid_bench

PLATFORM = """
import io, os, signal, subprocess, sys, sysconfig

sysconfig.get_config_vars()  # reads a file that is named by the platform
for name in ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty"):
    sys.modules[name] = None
subprocess.Popen.kill = lambda self: self.send_signal(9)  # which asks for SIGKILL
for module, names in (
    (os, "fork forkpty setsid getuid geteuid getgid getpgid killpg nice sysconf waitid pread "
         "pwrite getloadavg sched_getaffinity openpty mkfifo statvfs"),
    (signal, "SIGKILL SIGCHLD SIGHUP SIGALRM SIG_BLOCK pthread_sigmask sigwait setitimer"),
):
    for name in names.split():
        delattr(module, name)
sys.platform = "other"

def without_proc(function):
    def asked(path=".", *more, **named):
        if str(path).startswith("/proc"):
            raise FileNotFoundError(2, "no such file", str(path))
        return function(path, *more, **named)
    return asked

for module, name in ((io, "open"), (os, "listdir"), (os, "scandir"), (os, "stat")):
    setattr(module, name, without_proc(getattr(module, name)))
"""

CODE = """
import os, time
from dataclasses import dataclass

import numpy as np

from sysid_bench.excitation.design_problem import dense_grid, scale_to_limits
from sysid_bench.types import Estimate


@dataclass(frozen=True)
class Sine:
    def design(self, brief, rng):
        w, phase = 2 * np.pi * 0.2, rng.uniform(0, 2 * np.pi, brief.nv)

        def shape(t):
            angle = w * t[:, None] + phase
            return np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)

        grid, t = dense_grid(5.0, 0.2), brief.times(5.0)
        (scale, offset), (x, dx, ddx) = scale_to_limits(shape, grid, brief, rng), shape(t)
        return brief.trajectory(t, offset + scale * x, scale * dx, scale * ddx, "sine")


class Least:
    def solve(self, problem):
        return Estimate(np.linalg.lstsq(problem.W, problem.b, rcond=None)[0])


class Dies:
    def solve(self, problem):
        os._exit(3)


class Hangs:
    def solve(self, problem):
        with open(os.path.dirname(__file__) + "/hung", "w") as file:
            file.write(str(os.getpid()))
        while True:
            time.sleep(0.1)
"""

SUITE = """
schema = 1
name = "elsewhere"
[run]
timeout = "{timeout} s"
[defaults]
excitation = ["file:mine.py:Sine", {{ use = "fourier", harmonics = 3, period = "2 s", cycles = 1 }}]
held_out = ["ptp"]
simulation = {{ use = "inverse" }}
rate = "100 Hz"
[[robot]]
use = "scara"
"""


def rows(folder: Path, elsewhere: bool, *methods: str, timeout: int = 60) -> list[dict[Any, Any]]:
    """Rows of a run of these methods, here or on the other platform."""
    folder.mkdir()
    (folder / "mine.py").write_text(CODE)
    text = SUITE.format(timeout=timeout)
    text += "".join(f'[[estimator]]\nuse = "{method}"\n' for method in methods)
    (folder / "s.toml").write_text(text)
    environment = {**os.environ, "TMPDIR": str(folder)}
    if elsewhere:
        (folder / "platform").mkdir()
        (folder / "platform" / "sitecustomize.py").write_text(PLATFORM)
        environment["PYTHONPATH"] = str(folder / "platform")
    command = [sys.executable, "-m", "sysid_bench", "run", "s.toml", "-o", "out", "--jobs", "1"]
    done = subprocess.run(
        command, cwd=folder, env=environment, text=True, capture_output=True, timeout=240
    )
    assert done.returncode in (0, 3), done.stderr
    assert "Traceback" not in done.stderr
    return sysid_bench.open_run(folder / "out").cells.to_dict("records")


def test_scores_do_not_depend_on_posix(tmp_path: Path) -> None:
    methods = ("ols", "file:mine.py:Least", "file:mine.py:Dies")
    here, there = (rows(tmp_path / str(e), e, *methods) for e in (False, True))
    assert [row["status"] for row in there] == ["ok", "ok", "crash"] * 2
    kept = ("id", "status", "reason", "rmse_test", "torque_error")
    for one, other in zip(here, there, strict=True):
        assert {k: str(one.get(k)) for k in kept} == {k: str(other.get(k)) for k in kept}


def test_a_method_that_hangs_ends_with_its_worker(tmp_path: Path) -> None:
    found = rows(tmp_path / "run", True, "file:mine.py:Hangs", timeout=4)
    assert [row["status"] for row in found] == ["timeout"] * 2
    process = int((tmp_path / "run" / "hung").read_text())
    until = time.monotonic() + 10
    while Path(f"/proc/{process}").exists() and time.monotonic() < until:
        time.sleep(0.1)
    assert not Path(f"/proc/{process}").exists(), "the method went on without its worker"
