"""One table of ratios: what is compared is timed in turn in one process, CPU time of one thread."""

import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from sysid_bench.regressors.kernel_c import select_kernel
from sysid_bench.version_fields import environment
from tests.benchmarks import history

Function = Callable[[], Any]
TABLE = "SYSID_BENCH_SPEED"
"""The file that the table is written to as Markdown, beside being printed."""


@dataclass(frozen=True)
class Line:
    """One line of the table: at least or at most the targets, or no target at all."""

    quantity: str
    value: float
    must: float | None = None
    aim: float | None = None
    least: bool = False
    unit: str = "×"

    def words(self) -> tuple[str, str, str, str, str]:
        """quantity, measured, must, aim, verdict."""
        sign = "≥" if self.least else "≤"

        def target(x: float | None) -> str:
            return "" if x is None else f"{sign} {number(x)} {self.unit}"

        measured = f"{number(self.value)} {self.unit}"
        return self.quantity, measured, target(self.must), target(self.aim), self.verdict()

    @property
    def compared(self) -> bool:
        """True for ratios whose target says which direction is better."""
        return self.unit == "×" and self.must is not None

    def regressed(self, before: float | None) -> bool:
        """True where the ratio is worse than the stored one by the factor."""
        return history.worse(self.value, before, self.least)

    def verdict(self) -> str:
        def met(target: float | None) -> bool:
            return target is not None and (
                self.value >= target if self.least else self.value <= target
            )

        if self.must is None:
            return ""
        return "aim" if met(self.aim) else "must" if met(self.must) else "MISSED"


def number(x: float) -> str:
    """Three digits."""
    return f"{x:.0f}" if abs(x) >= 100 else f"{x:.3g}"


LINES: list[Line] = []
ABSENT: list[str] = []


@pytest.fixture
def line() -> Callable[..., None]:
    """Adds a line to the table; fails where its ratio is worse than the stored one."""

    def add(*args: Any, **kwargs: Any) -> None:
        added = Line(*args, **kwargs)
        LINES.append(added)
        before = history.stored().get(history.processor(), {}).get(added.quantity)
        if added.compared and not history.keeps() and added.regressed(before):
            pytest.fail(
                f"{added.quantity}: {number(added.value)}, {number(before or 0.0)} before on this "
                f"processor (factor {history.FACTOR:g}); {history.KEEP}=keep takes it over."
            )

    return add


@pytest.fixture
def compare(benchmark: Any) -> Callable[[dict[str, Function], int], dict[str, float]]:
    """CPU seconds of functions, the median of rounds in which each has its turn."""

    def timed(functions: dict[str, Function], rounds: int = 7) -> dict[str, float]:
        seconds: dict[str, list[float]] = {name: [] for name in functions}

        def one_round() -> None:
            for name, function in functions.items():
                start = time.thread_time()
                function()
                seconds[name].append(time.thread_time() - start)

        benchmark.pedantic(one_round, rounds=rounds, warmup_rounds=1)
        middle = {name: median(values[1:] or values) for name, values in seconds.items()}
        benchmark.extra_info.update(middle)
        return middle

    return timed


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    threads = os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS")
    if threads != ("1", "1"):
        pytest.skip("ratios are measured with one BLAS thread: `make bench` sets it")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Remembers what could not be compared, and why."""
    if report.skipped and isinstance(report.longrepr, tuple):
        ABSENT.append(f"{report.nodeid.split('::')[-1]}: {report.longrepr[2]}")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Prints the table, and writes it where the variable says."""
    if not LINES:
        return
    if history.keeps():
        history.keep({one.quantity: one.value for one in LINES if one.compared})
    text = "\n".join(table())
    terminalreporter.section("ratios")
    terminalreporter.write_line(text)
    if os.environ.get(TABLE):
        Path(os.environ[TABLE]).write_text(text + "\n", encoding="utf-8")


def table() -> Iterator[str]:
    """The report in Markdown."""
    yield "# Speed"
    yield ""
    yield f"Made by `{TABLE}=reports/reference/speed.md make bench`: ratios of CPU time of one"
    yield "thread, what is compared timed in turn in one process, medians. `must` and `aim` are the"
    yield "targets."
    yield ""
    git = environment()["git"] or {"commit": "unknown", "dirty": None}
    changes = " with changes" if git["dirty"] else ""
    yield f"- commit: {str(git['commit'])[:8]}{changes}, {date.today()}"
    yield f"- machine: {history.processor()}, {os.cpu_count()} cores, {platform.system()}"
    yield f"- regressor kernel: {select_kernel()}"
    yield f"- versions: {versions()}"
    yield ""
    rows = [("quantity", "measured", "must", "aim", "met"), *(line.words() for line in LINES)]
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    rows.insert(1, tuple("-" * width for width in widths))  # type: ignore[arg-type]
    for row in rows:
        yield "| " + " | ".join(word.ljust(w) for word, w in zip(row, widths, strict=True)) + " |"
    if ABSENT:
        yield ""
        yield "Not measured here:"
        yield ""
        yield from (f"- {reason}" for reason in ABSENT)


def versions() -> str:
    """Versions of the peers."""
    from importlib.metadata import PackageNotFoundError, version

    found = [f"Python {platform.python_version()}"]
    for package in ("numpy", "scipy", "mujoco", "pin", "idyntree", "figaroh"):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)
