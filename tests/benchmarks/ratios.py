"""Speed ratios against committed ones, robust on a loaded machine: `make ratios`.

What is compared runs in turn in one process, in pairs of CPU times that see the same load. A ratio
is the median over pairs; its noise, from the spread of the pairs, decides how many are measured and
what a difference means: a ratio is worse where it is above LIMIT of the committed one by three
standard errors. `python -m tests.benchmarks.ratios --keep` replaces those of this processor.
"""

import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks import history

FILE = history.FILE.with_name("ratios.json")
LIMIT = 1.1
"""Ratios above the committed ones that are no change; one of 1.2 is named where its standard error
is below 3 %."""
SIGMAS = 3.0
PAIRS = (5, 200)
"""Fewest and most pairs."""
SECONDS = 8.0
"""Most wall time of the pairs of one ratio, after the fewest."""

Function = Callable[[], Any]


@dataclass(frozen=True)
class Ratio:
    """Median of paired ratios, and its standard error."""

    value: float
    error: float
    pairs: int

    def verdict(self, allowed: float | None) -> str:
        """ "ok", "worse", "noisy" where a change of 1.2 would not be seen, "" without a committed
        one."""
        if allowed is None:
            return ""
        if self.value - SIGMAS * self.error > LIMIT * allowed:
            return "worse"
        return "noisy" if self.value + SIGMAS * self.error > 1.2 * allowed else "ok"


def ratio_of(pairs: Any) -> Ratio:
    """Median of ratios (n,), with the standard error of the median of Gaussian values of their
    spread: sqrt(pi / 2) sigma / sqrt(n), sigma from the median absolute deviation."""
    values = np.asarray(pairs, dtype=float)
    middle = float(np.median(values))
    sigma = 1.4826 * float(np.median(np.abs(values - middle)))
    return Ratio(middle, np.sqrt(np.pi / 2) * sigma / np.sqrt(len(values)), len(values))


def cpu() -> float:
    """CPU seconds of this process and of those that it waited for."""
    # In microseconds; `os.times` counts in hundredths of a second, a tenth of a start of Python.
    parts = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in parts)


def measured(ours: Function, other: Function, clock: Callable[[], float]) -> Ratio:
    """CPU time of `ours` over that of `other`, pairs in turns of order."""
    for function in (ours, other):
        function()
    pairs: list[float] = []
    start = time.perf_counter()
    while len(pairs) < PAIRS[1]:
        spent: dict[Function, float] = {}
        for function in (ours, other) if len(pairs) % 2 else (other, ours):
            before = clock()
            function()
            spent[function] = clock() - before
        pairs.append(spent[ours] / spent[other])
        found = ratio_of(pairs)
        enough = SIGMAS * found.error < 0.03 * found.value or time.perf_counter() - start > SECONDS
        if len(pairs) >= PAIRS[0] and enough:
            break
    return ratio_of(pairs)


def regressors() -> Iterator[tuple[str, Function, Function]]:
    """One sample and a batch against Pinocchio from Python."""
    from tests.benchmarks import peers
    from tests.benchmarks.test_kernels import Subject

    subject = Subject("xarm7")
    few = subject.few(200)
    peer = peers.pinocchio_in_python(subject.robot, few)
    sample, samples = subject.columns.sample(), list(zip(few.q, few.v, few.a, strict=True))

    def each() -> None:
        for q, v, a in samples:
            sample(q, v, a)

    yield "200 samples, one a call / Pinocchio from Python", each, peer
    many = f"{len(subject.motion):,} samples at once / 200 of Pinocchio from Python"
    yield many, subject.dense, peer


def plants() -> Iterator[tuple[str, Function, Function]]:
    """Compiled steps of many plants against MuJoCo's batched rollout."""
    from tests.benchmarks import test_batched_simulation as batched
    from tests.robots import named_robot

    batched.SECONDS = 0.5
    ours, other = batched.subject(named_robot("xarm7"), "sticking")
    yield "32 plants in compiled steps / MuJoCo's batched rollout", ours, other


def fits() -> Iterator[tuple[str, Function, Function]]:
    """A robust fit against weighted least squares with its factors, from the same samples."""
    from sysid_bench.identification.estimators.robust import Huber
    from sysid_bench.identification.linear.least_squares import scaled_fit
    from sysid_bench.regressors.block_qr import MotionBlocks, motion_factors
    from sysid_bench.types import Problem
    from tests.benchmarks.test_downstream import Subject

    arm = Subject("xarm7", 100_000)
    rng = np.random.default_rng(2)
    tau = arm.columns.torque(arm.motion, rng.normal(size=arm.base.rank))
    tau += 0.1 * rng.standard_t(3, size=tau.shape)
    factors = motion_factors(arm.columns, arm.motion, tau)
    blocks = MotionBlocks(arm.columns, arm.motion, tau, tuple(range(arm.robot.nv)))
    problem = Problem(
        arm.columns.columns, arm.base, arm.robot.rows, factors, (), blocks, len(arm.motion)
    )

    def wls() -> None:
        motion_factors(arm.columns, arm.motion, tau)
        scaled_fit(problem)

    yield "huber / wls with its factors, 100,000 samples", lambda: Huber().solve(problem), wls


def experiments() -> Iterator[tuple[str, Function, Function]]:
    """A closed-loop experiment with two estimators against the rollout of its motion."""
    from tests.benchmarks.test_experiment import Bench

    bench = Bench(())
    yield "experiment of 10 s / bare rollout", bench.experiment, bench.rollout


def processes() -> Iterator[tuple[str, Function, Function]]:
    """Starting and running against a start of Python with NumPy."""
    from reports.make.cell_overhead import cpu_of_run
    from tests.benchmarks.test_house import COMMANDS, cpu_of_children

    def numpy() -> None:
        cpu_of_children(COMMANDS["import numpy"])

    def one_cell() -> None:
        with tempfile.TemporaryDirectory() as folder:
            words = ["run", "suites/smoke.toml", "--limit", "1", "-o", f"{folder}/run"]
            cpu_of_children(["-m", "sysid_bench", *words])

    plan = ["-m", "sysid_bench", "plan", "suites/smoke.toml"]
    yield "400 trivial cells / import numpy", lambda: cpu_of_run(40, 10), numpy
    yield "plan of suite smoke / import numpy", lambda: cpu_of_children(plan), numpy
    yield "run of one cell of suite smoke / import numpy", one_cell, numpy


def main(*words: str) -> int:
    """Print the table; 1 where a ratio is worse."""
    allowed: Mapping[str, float] = history.stored(FILE).get(history.processor(), {})
    found: dict[str, float] = {}
    worse, start = 0, time.perf_counter()
    print(f"Ratios of CPU time on {history.processor()}; allowed: {LIMIT:g} of the committed one.")
    for group in (regressors, plants, fits, experiments, processes):
        for name, ours, other in group():
            clock = cpu if group is processes else time.thread_time
            ratio = measured(ours, other, clock)
            verdict = ratio.verdict(allowed.get(name))
            found[name], worse = ratio.value, worse + (verdict == "worse")
            committed = f"{allowed[name]:8.3g}" if name in allowed else "       -"
            spread = f"{ratio.value:8.3g} +- {100 * ratio.error / ratio.value:4.1f} %"
            print(f"{name:58} {spread} of {ratio.pairs:3d} pairs {committed} {verdict}", flush=True)
    print(f"{time.perf_counter() - start:.0f} s")
    if "--keep" in words:
        history.keep(found, FILE)
    elif not allowed:
        print(f"{FILE.name} has no ratios of this processor: --keep adds them.")
    return 1 if worse and "--keep" not in words else 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    sys.exit(main(*sys.argv[1:]))
