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


class _Count:
    """Cells of a run and their expected costs, counted from its events."""

    def __init__(self) -> None:
        self.costs: dict[str, float] = {}
        self.cells: int | str = "?"
        self.done = self.failed = 0
        self.cost = 0.0

    def take(self, kind: str, data: Mapping[str, Any]) -> bool:
        """Take an event, print which third-party code a run executes; True for a row."""
        if kind == "code":
            print(data["note"], file=sys.stderr)
        elif kind == "plan":
            self.costs, self.cells = dict(data["seconds"]), data["open"]
        elif kind == "row":
            self.done += 1
            self.failed += data["status"] in FAILURES
            self.cost += self.costs.get(data["id"], 0.0)
        return kind == "row"

    @property
    def total(self) -> float:
        """Expected cost of all cells."""
        return sum(self.costs.values()) or 1.0


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
        count = _Count()

        def listen(kind: str, data: Mapping[str, Any]) -> None:
            count.take(kind, data)
            if kind in ("plan", "row"):
                failed = f" ({count.failed} failed)" if count.failed else ""
                bar.update(
                    task, total=count.total, completed=count.cost, done=count.done,
                    cells=count.cells, description=f"running{failed}",
                )  # fmt: skip

        yield listen


class ProgressLines:
    """Prints how far a run is, at most once in `interval` seconds: for the logs of CI."""

    def __init__(self, interval: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._interval, self._clock = interval, clock
        self._start = self._printed = clock()
        self._count = _Count()

    def update(self, kind: str, data: Mapping[str, Any]) -> None:
        """Take an event of a run."""
        is_row, count, now = self._count.take(kind, data), self._count, self._clock()
        if not is_row or now - self._printed < self._interval:
            return
        self._printed, passed = now, now - self._start
        share = count.cost / count.total
        failed = f", {count.failed} failed" if count.failed else ""
        known = _LEAST_SHARE <= share < 1.0
        left = f", about {passed * (1.0 / share - 1.0):.0f} s left" if known else ""
        words = f"{count.done}/{count.cells} cells{failed}, {100 * share:.0f} %"
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
