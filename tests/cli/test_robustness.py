"""Failures stay where they happen: other experiments unharmed, one sentence each, right codes."""

import html
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from sysid_bench.words import MACHINE_FIELDS

from .conftest import Run, one_sentence, rows_of, small_suite

pytestmark = pytest.mark.long

METHODS = """
import os, signal, time
from sysid_bench.words import MACHINE_FIELDS
from sysid_bench.types import Estimate

class Dies:
    def solve(self, problem):
        os.kill(os.getpid(), signal.SIGSEGV)

class Hangs:
    def solve(self, problem):
        time.sleep(1000)

class Raises:
    def solve(self, problem):
        raise ValueError("no luck today")

class Lies:
    def solve(self, problem):
        return Estimate(problem.base.K[:, 0] * float("nan"))
"""
NOT_SCORES = {*MACHINE_FIELDS, "row_sha256"}


def test_a_method_that_dies_hangs_raises_or_lies_harms_no_other_experiment(
    program: Run, tmp_path: Path
) -> None:
    (tmp_path / "bad.py").write_text(METHODS)
    bad = {"Raises": "failed", "Lies": "failed", "Dies": "crash", "Hangs": "timeout"}
    (tmp_path / "s.toml").write_text(
        small_suite(
            payloads=("none", "sphere-1kg"),
            estimators=("ols", *(f"file:bad.py:{name}" for name in bad)),
        )
    )
    done = program(
        "run", "s.toml", "-o", "out", "-j", "2", "--timeout", "15 s", "--select", 'noise == "exact"'
    )
    assert done.returncode == 3, done.stderr
    rows = rows_of(tmp_path / "out")
    assert len(rows) == len({row["id"] for row in rows}) == 10
    statuses = {(row["estimator"], row["payload"]): row["status"] for row in rows}
    assert statuses == {
        (name, payload): status
        for name, status in ({"ols": "ok"} | bad).items()
        for payload in ("none", "sphere-1kg")
    }
    reasons = {"crash": "SIGSEGV", "timeout": "15 s", "failed": ""}
    assert all(row["reason"] for row in rows if row["status"] != "ok")
    assert all(reasons[row["status"]] in row["reason"] for row in rows if row["status"] != "ok")
    assert any("no luck today" in row.get("traceback", "") for row in rows)


def test_a_broken_robot_fails_alone(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "broken.urdf").write_text("<robot name='x'><link name='a'/>")
    (tmp_path / "s.toml").write_text(small_suite(robots=("file:broken.urdf", "ur5")))
    done = cli("run", "s.toml", "-o", "out", "-j", "1")
    assert done.returncode == 3
    rows = rows_of(tmp_path / "out")
    assert {(row["robot"], row["status"]) for row in rows} == {("broken", "failed"), ("ur5", "ok")}
    (reason,) = {row["reason"] for row in rows if row["status"] == "failed"}
    assert "broken.urdf" in reason
    assert "well-formed" in reason


def test_nan_in_a_manifest_is_one_sentence(cli: Run, tmp_path: Path) -> None:
    robot = tmp_path / "mine" / "arm"
    robot.mkdir(parents=True)
    (robot / "robot.toml").write_text(
        'name = "arm"\nfile = "example-robot-data:ur_description/urdf/ur5_robot.urdf"\n'
        "gravity = [0, 0, nan]\n[limits.all]\nv = nan\n"
    )
    (tmp_path / "s.toml").write_text(small_suite(robots=("arm",)))
    done = cli("run", "s.toml", "--robots", "mine")
    assert done.returncode == 2
    result = one_sentence(done)
    assert "limits.all.v" in result
    assert "gravity" in result
    assert "finite" in result


def test_a_run_remembers_the_folder_of_its_robots(cli: Run, tmp_path: Path) -> None:
    robot = tmp_path / "my arms" / "arm"
    robot.mkdir(parents=True)
    (robot / "robot.toml").write_text(
        'name = "arm"\nfile = "example-robot-data:ur_description/urdf/ur5_robot.urdf"\n'
    )
    (tmp_path / "s.toml").write_text(small_suite(robots=("arm",)))
    typed = ("run", "s.toml", "--robots", "my arms", "--set", "seed=7")
    assert cli(*typed, "-o", "out", "-j", "1", "--limit", "2").returncode == 0
    done = cli("run", "out", "-j", "1")
    assert done.returncode == 0, done.stderr
    state = json.loads(cli("status", "out", "--json").stdout)
    assert (list(state["statuses"]), state["open"]) == (["ok"], 0)
    first = rows_of(tmp_path / "out")[0]["id"]
    command = json.loads(cli("cell", "out", first, "--json").stdout)["command"]
    assert cli(*shlex.split(command)[1:]).returncode == 0
    assert cli("record", "out", first).returncode == 0
    report = (tmp_path / "out" / "report.html").read_text()
    command = shlex.join(["sysid-bench", *typed])
    assert command in html.unescape(report)
    assert f"{command} --limit" not in html.unescape(report)  # the run is whole by now


def test_an_unknown_estimator_runs_nothing(cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(small_suite(estimators=("ols", "wsl")))
    done = cli("run", "s.toml", "-o", "out")
    assert done.returncode == 2
    assert "'wls'" in one_sentence(done)
    assert not (tmp_path / "out").exists()


def scores(run: Path) -> dict[str, dict[str, Any]]:
    """id -> the row without its times; fails where a cell has more than one row."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows_of(run):
        assert row["id"] not in found, f"cell {row['id']} has two rows"
        found[row["id"]] = {key: value for key, value in row.items() if key not in NOT_SCORES}
    return found


def test_killed_at_any_moment_a_run_goes_on_as_if_nothing_had_happened(
    cli: Run, tmp_path: Path
) -> None:
    (tmp_path / "s.toml").write_text(
        small_suite(robots=("ur5", "panda"), payloads=("none", "sphere-1kg", "box-2kg"))
    )
    assert cli("run", "s.toml", "-o", "calm", "-j", "1").returncode == 0
    moments = random.Random(20261121)
    command = [sys.executable, "-m", "sysid_bench", "run", "s.toml", "-o", "harried", "-j", "2"]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    for _ in range(4):
        runner = subprocess.Popen(
            command, cwd=tmp_path, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(moments.uniform(1.0, 3.5))
        runner.send_signal(signal.SIGKILL)
        runner.wait()
    done = cli("run", "s.toml", "-o", "harried", "-j", "2")
    assert done.returncode == 0, done.stderr
    calm, harried = scores(tmp_path / "calm"), scores(tmp_path / "harried")
    assert calm == harried  # bit for bit: JSON writes the shortest text that reads back the same
    assert len(calm) == 36


PLUGINS = """
import numpy as np
from dataclasses import dataclass

@dataclass(frozen=True)
class Wobble:
    size: float = 0.1

    def design(self, brief, rng):
        t = brief.times(4.0)
        w = 2 * np.pi * (1 + np.arange(brief.nv)) / 4
        middle = 0.5 * (brief.low + brief.high)
        x = middle + self.size * np.sin(np.outer(t, w))
        dx, ddx = self.size * w * np.cos(np.outer(t, w)), -self.size * w**2 * np.sin(np.outer(t, w))
        return brief.trajectory(t, x, dx, ddx, "wobble", 4.0)

class Heavy:
    def prepare(self, robot):
        return lambda t, q, v: 0.5 * np.ones_like(v)
"""


def test_plug_in_files_lie_beside_the_suite_wherever_one_stands(cli: Run, tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "mine.py").write_text(PLUGINS)
    text = small_suite(estimators=("ols",)).replace(
        'excitation = { use = "fourier", harmonics = 3, period = "2 s", cycles = 2 }',
        'excitation = "file:mine.py:Wobble"\nplant = ["matched", "file:mine.py:Heavy"]',
    )
    (lab / "s.toml").write_text(text)
    done = cli("run", "lab/s.toml", "-o", "out", "-j", "1", "--select", 'noise == "exact"')
    assert done.returncode == 0, done.stderr
    errors = {row["plant"]: row["torque_error"] for row in rows_of(tmp_path / "out")}
    assert errors["matched"] < 1e-9 < 1e-4 < errors["Heavy"]
