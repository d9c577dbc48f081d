"""Progress, weighted by the expected cost of cells: a bar on a terminal, else a line a minute."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.worker_execute import worker_progress
from sysid_bench.errors import FAILURES

if TYPE_CHECKING:
    from pathlib import Path

    from sysid_bench.harness.work.supervise import OnEvent


_LEAST_SHARE: Final = 0.01
"""Share of the expected cost from which the rest of a run is estimated from it."""


@contextmanager
def run_progress() -> Iterator["OnEvent"]:
    """Yield a listener for a run's events."""
    if not sys.stderr.isatty():
        yield ProgressLines().update
        return
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TextColumn("{task.fields[done]}/{task.fields[cells]} cells"),
        bars.TimeElapsedColumn(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading suite and models", total=None, done=0, cells="?")
        costs: dict[str, float] = {}
        cells = {"done": 0, "failed": 0}

        def listen(kind: str, data: Mapping[str, Any]) -> None:
            _print_code(kind, data)
            if kind == "plan":
                costs.update(data["seconds"])
                total = sum(costs.values()) or 1.0
                bar.update(task, total=total, cells=data["open"], description="running")
            elif kind == "row":
                cells["done"] += 1
                cells["failed"] += data["status"] in FAILURES
                words = f"running ({cells['failed']} failed)" if cells["failed"] else "running"
                bar.update(
                    task, advance=costs.get(data["id"], 0.0), done=cells["done"], description=words
                )

        yield listen


class ProgressLines:
    """Prints how far a run is, at most once in `interval` seconds: for the logs of CI."""

    def __init__(self, interval: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._interval, self._clock = interval, clock
        self._start = self._printed = clock()
        self._costs: dict[str, float] = {}
        self._cells = self._done = self._failed = 0
        self._cost = 0.0

    def update(self, kind: str, data: Mapping[str, Any]) -> None:
        """Take an event of a run."""
        _print_code(kind, data)
        if kind == "plan":
            self._costs, self._cells = dict(data["seconds"]), data["open"]
        elif kind == "row":
            self._done += 1
            self._failed += data["status"] in FAILURES
            self._cost += self._costs.get(data["id"], 0.0)
            self._print()

    def _print(self) -> None:
        now = self._clock()
        if now - self._printed < self._interval:
            return
        self._printed = now
        share = self._cost / (sum(self._costs.values()) or 1.0)
        failed = f", {self._failed} failed" if self._failed else ""
        passed = now - self._start
        known = _LEAST_SHARE <= share < 1.0
        left = f", about {passed * (1.0 / share - 1.0):.0f} s left" if known else ""
        words = f"{self._done}/{self._cells} cells{failed}, {100 * share:.0f} %"
        print(f"{words} after {passed:.0f} s{left}", file=sys.stderr)


@contextmanager
def search_progress() -> Iterator[Callable[[int, float], None]]:
    """Yield a listener for a search: evaluations and the best value so far, on one line. That of a
    worker reports to the command that has started it."""
    listener = worker_progress()
    if listener is not None:
        yield listener
        return
    if not sys.stderr.isatty():
        yield lambda count, value: None
        return

    def show(count: int, value: float) -> None:
        sys.stderr.write(f"\r{count:6d} evaluations, objective {value:.5g} \x1b[K")
        sys.stderr.flush()

    yield show
    # Carriage return, then erase to the end of the line.
    sys.stderr.write("\r\x1b[K")


@contextmanager
def read_progress() -> Iterator[None]:
    """Show on one line how far the reading of a long recording has come, on a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from sysid_bench.signals.log_library import report_to

    def show(path: "Path", share: float) -> None:
        # Erased at the end of each file: results, or the sentence of an error, stand on its line.
        words = f"reading {path.name}: {100 * share:3.0f} % " if share < 1.0 else ""
        sys.stderr.write(f"\r{words}\x1b[K")
        sys.stderr.flush()

    with report_to(show):
        yield


def _print_code(kind: str, data: Mapping[str, Any]) -> None:
    """Print which third-party code a run executes."""
    if kind == "code":
        print(data["note"], file=sys.stderr)
