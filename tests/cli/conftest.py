"""The command line as a user meets it, in an empty folder."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sysid_bench.commands.main import main

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def cli(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """`cli("plan", "smoke")` runs sysid-bench in an empty folder, within this process.

    Loading the libraries takes longer than most commands. Workers are processes all the same.
    """

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        with monkeypatch.context() as patch:
            patch.chdir(tmp_path)
            patch.setattr(sys, "path", list(sys.path))
            done = CliRunner(catch_exceptions=False).invoke(main, words, prog_name="sysid-bench")
        return subprocess.CompletedProcess(words, done.exit_code, done.stdout, done.stderr)

    return run


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
