"""What the house itself costs: starting, a cell that does nothing, a second worker."""

import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from sysid_bench.verbs.runs.run import run

Line = Callable[..., None]
COMMANDS = {
    "import numpy": ["-c", "import numpy"],
    "import sysid_bench": ["-c", "import sysid_bench"],
    "sysid-bench --help": ["-m", "sysid_bench", "--help"],
}
TRIVIAL = """
from dataclasses import dataclass
import numpy as np
from sysid_bench.types import Estimate

@dataclass(frozen=True)
class Nothing:
    number: int = 0
    claims: bool = True
    def solve(self, problem):
        if not self.claims:
            return Estimate(status="unsupported", reason="it has nothing to score")
        return Estimate(np.zeros(problem.base.rank))
"""
SUITE = """
schema = 1
name = "trivial"
[run]
repeats = {repeats}
[defaults]
excitation = {{ use = "fourier", period = "{period}", cycles = 1 }}
simulation = {{ use = "{simulation}" }}
held_out = ["ptp"]
rate = "{rate}"
noise = {{ tau = "0.1 %" }}
[[robot]]
use = "{robot}"
"""


def cpu_seconds() -> float:
    """CPU seconds of this process and of those that it waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def cpu_of_children(arguments: list[str]) -> float:
    """CPU seconds of a Python process."""
    before = cpu_seconds()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return cpu_seconds() - before


def test_starting(benchmark: Any, line: Line) -> None:
    seconds: dict[str, list[float]] = {name: [] for name in COMMANDS}

    def one_round() -> None:
        for name, arguments in COMMANDS.items():
            seconds[name].append(cpu_of_children(arguments))

    benchmark.pedantic(one_round, rounds=9, warmup_rounds=1)
    numpy, *ours = (median(values[1:] or values) for values in seconds.values())
    for name, value in zip(list(COMMANDS)[1:], ours, strict=True):
        line(f"{name} / import numpy", value / numpy, 2.5, 1.5)


def ran(folder: Path, name: str, estimators: str, jobs: int = 1, **words: Any) -> dict[str, float]:
    """Wall and CPU seconds of a run, and its cells, without tables and report."""
    text = {"repeats": 1, "period": "1 s", "simulation": "inverse", "rate": "100 Hz"}
    suite = folder / f"{name}.toml"
    suite.write_text(SUITE.format(**{**text, "robot": "z1", **words}) + estimators)
    start = time.perf_counter(), cpu_seconds()
    result = run(suite, folder / name, jobs=jobs)
    assert set(result.counts) <= {"ok", "unsupported"}, result.counts
    return {
        "wall": time.perf_counter() - start[0],
        "cpu": cpu_seconds() - start[1],
        "cells": result.asked,
    }


@pytest.mark.parametrize("claims", [False, True])
def test_a_cell_that_does_nothing(claims: bool, benchmark: Any, line: Line, tmp_path: Path) -> None:
    (tmp_path / "nothing.py").write_text(textwrap.dedent(TRIVIAL))

    def estimators(count: int) -> str:
        use = f'use = "file:{tmp_path / "nothing.py"}:Nothing"\nclaims = {str(claims).lower()}'
        return "".join(f"[[estimator]]\n{use}\nnumber = {k}\n" for k in range(count))

    costs: list[float] = []

    def one_round() -> None:
        place = f"{len(costs)}"
        few = ran(tmp_path, f"few{place}", estimators(20))
        many = ran(tmp_path, f"many{place}", estimators(420))
        costs.append(1e3 * (many["cpu"] - few["cpu"]) / (many["cells"] - few["cells"]))

    benchmark.pedantic(one_round, rounds=3)
    if claims:
        line("the same with the scores of two motions", median(costs), unit="ms")
    else:
        line("harness per trivial cell", median(costs), 2, 2, unit="ms")


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one core")
def test_a_second_worker(benchmark: Any, line: Line, tmp_path: Path) -> None:
    ratios: list[float] = []
    ols = '[[estimator]]\nuse = "ols"\n'
    words = {"robot": "xarm7", "simulation": "closed-loop", "period": "10 s", "rate": "1 kHz"}

    def one_round() -> None:
        place = f"{len(ratios)}"

        def rate(jobs: int) -> float:
            few = ran(tmp_path, f"few{place}-{jobs}", ols, jobs, repeats=2 * jobs, **words)
            many = ran(tmp_path, f"many{place}-{jobs}", ols, jobs, repeats=42, **words)
            # The difference is without starting the workers.
            return (many["cells"] - few["cells"]) / (many["wall"] - few["wall"])

        ratios.append(rate(2) / rate(1))

    benchmark.pedantic(one_round, rounds=3)
    line("experiments per second, two workers / one (idle cores)", median(ratios), 1.8, 1.8, True)
