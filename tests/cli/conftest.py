"""The command line as a user meets it, in an empty folder."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import sysid_bench
from sysid_bench.commands.main import main

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def cli_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], Run]:
    """`cli_in(folder)("plan", "smoke")` runs sysid-bench in a folder, within this process.

    Loading the libraries takes longer than most commands. Workers are processes all the same.
    """

    def of(folder: Path) -> Run:
        def run(*words: str) -> subprocess.CompletedProcess[str]:
            with monkeypatch.context() as patch:
                patch.chdir(folder)
                patch.setattr(sys, "path", list(sys.path))
                runner = CliRunner(catch_exceptions=False)
                done = runner.invoke(main, words, prog_name="sysid-bench")
            return subprocess.CompletedProcess(words, done.exit_code, done.stdout, done.stderr)

        return run

    return of


@pytest.fixture
def cli(tmp_path: Path, cli_in: Callable[[Path], Run]) -> Run:
    """`cli("plan", "smoke")` runs sysid-bench in an empty folder."""
    return cli_in(tmp_path)


@pytest.fixture
def program(tmp_path: Path) -> Run:
    """`program("plan", "smoke")` runs sysid-bench in an empty folder, as a process of its own."""

    def run(*words: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "sysid_bench", *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
            text=True,
            capture_output=True,
            timeout=timeout,
        )

    return run


def rows_of(run: Path) -> list[dict[str, Any]]:
    """Every line of cells/*.jsonl that is a row, torn ones left out."""
    rows = []
    for file in sorted((run / "cells").glob("*.jsonl")):
        for line in file.read_text().splitlines():
            try:
                rows.append(json.loads(line))
            except json.JSONDecodeError:
                continue
    return rows


def one_sentence(done: subprocess.CompletedProcess[str]) -> str:
    """The error of a refused command: on stderr, short, without a traceback."""
    assert "Traceback" not in done.stderr + done.stdout, done.stderr
    assert done.stderr.startswith("sysid-bench: "), done.stderr
    assert len(done.stderr) < 2000
    return done.stderr


ROBOT = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
 <body><joint name="j1" axis="0 0 1" range="-2 2"/>
  <inertial mass="3" pos="0.1 0 0" diaginertia="0.02 0.03 0.03"/>
  <body name="arm" pos="0.3 0 0"><joint name="j2" axis="0 1 0" range="-2 2"/>
   <inertial mass="1.5" pos="0.1 0 0.02" diaginertia="0.01 0.02 {izz}"/>
  </body></body></worldbody></mujoco>
"""
ARM = "example-robot-data:double_pendulum_description/urdf/double_pendulum_continuous.urdf"
SUITE = f"""
schema = 1
name   = "stored"
[run]
repeats = 6
[defaults]
prior      = {{ mass = "20 %", com = "15 mm", inertia = "30 %", terms = "30 %" }}
excitation = {{ use = "fourier", period = "2 s", cycles = 1 }}
held_out   = [["fourier-other"]]
rate       = "50 Hz"
noise      = {{ tau = "1 %" }}
signals    = {{ filter = "none", derivatives = "exact" }}
[[robot]]
use = "{ARM}"
[[estimator]]
use = "wls"
[[estimator]]
use = "prior"
"""
"""The stored suite without its claims and outputs: twelve cells."""

FIRST_CLAIM = """
[[claim]]
name      = "data-help"
statement = "Data help"
source    = "nobody 2026"
select    = 'estimator == "wls"'
against   = 'estimator == "prior"'
metric    = "torque_error"
threshold = 1.0
over      = "repeat"
gate      = true
"""
OTHER_CLAIMS = """
[[claim]]
name      = "data-harm"
statement = "Data do harm"
source    = "nobody 2026"
select    = 'estimator == "wls"'
against   = 'estimator == "prior"'
metric    = "torque_error"
direction = "at least"
threshold = 1.0
over      = "repeat"
gate      = true
[[claim]]
name      = "one-robot"
statement = "One robot is enough"
source    = "nobody 2026"
select    = 'estimator == "wls"'
statistic = "median"
metric    = "torque_error"
threshold = 1.0
gate      = true
[[claim]]
name      = "warm"
statement = "Friction falls with temperature"
source    = "nobody 2026"
missing   = "a thermometer"
[[claim]]
name      = "retracted"
statement = "Friction rises with temperature"
source    = "nobody 2026"
withdrawn = "its source was retracted"
"""


OUTPUTS = """
[[table]]
name    = "errors"
columns = ["estimator"]
cells   = { metric = "torque_error" }
[[macro]]
name    = "WlsError"
metric  = "torque_error"
select  = 'estimator == "wls"'
[[macro]]
name    = "Cells"
stat    = "count"
"""


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with s.toml, its run, the baseline b.json of it, and arm.xml; tests only read it."""
    folder = tmp_path_factory.mktemp("stored")
    (folder / "arm.xml").write_text(ROBOT.format(izz=0.02))
    (folder / "s.toml").write_text(SUITE + FIRST_CLAIM + OTHER_CLAIMS + OUTPUTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = CliRunner().invoke(
            main, ["run", "s.toml", "-o", "run", "-j", "1", "--set", "run.timeout=50s"]
        )
    assert done.exit_code == 0, done.output
    sysid_bench.baseline_save(folder / "run", folder / "b.json")
    return folder


@pytest.fixture
def copied(stored: Path, tmp_path: Path) -> Path:
    """The folder of the command line, with a copy of what is stored."""
    return Path(shutil.copytree(stored, tmp_path, dirs_exist_ok=True))


def keep_rows(run: Path, is_kept: Callable[[dict[str, Any]], bool]) -> None:
    """Leave some rows of a run alone, as a run has them that was interrupted."""
    for file in (run / "cells").glob("*.jsonl"):
        lines = file.read_text().splitlines(keepends=True)
        file.write_text("".join(line for line in lines if is_kept(json.loads(line))))


SMALL = """
schema = 1
name = "small"
seed = 1
[run]
timeout = "30 s"
repeats = 2
[defaults]
excitation = {{ use = "fourier", harmonics = 3, period = "2 s", cycles = 2 }}
rate = "50 Hz"
noise = [{{}}, {{ tau = "1 %" }}]
[[robot]]
use = {robots}
payloads = {payloads}
{estimators}
"""


def small_suite(
    robots: tuple[str, ...] = ("ur5",),
    payloads: tuple[str, ...] = ("none",),
    estimators: tuple[str, ...] = ("ols", "wls"),
    more: str = "",
) -> str:
    """A suite of a few quick cells."""
    blocks = "\n".join(f'[[estimator]]\nuse = "{name}"' for name in estimators)
    text = SMALL.format(robots=json.dumps(robots), payloads=json.dumps(payloads), estimators=blocks)
    return text + more
