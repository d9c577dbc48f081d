"""Items of pytest for the cells of a suite (see pytest_cells.py).

The selected cells run once, in a process of their own (with as many workers as pytest-xdist has
processes), and every item waits for its row, whichever process has it.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import pytest

from sysid_bench.commands.baseline import read_baseline
from sysid_bench.commands.gate import cell_text
from sysid_bench.commands.plan import plan
from sysid_bench.errors import SysidBenchError
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.comparison.baseline import Baseline
from sysid_bench.harness.comparison.run_values import label_axes
from sysid_bench.harness.run import run as run_cells
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.work.row_files import NewRows
from sysid_bench.package_folders import suite
from sysid_bench.types import Row

try:
    import fcntl
except ImportError:  # Windows has no flock, by which items know that their run goes on
    fcntl = None  # type: ignore[assignment]

_POLL_SECONDS: Final = 0.05
_GUARD_SECONDS: Final = 0.5
_SKIPPED: Final = ("unsupported", "skipped")


def suite_files(config: pytest.Config, named: Sequence[str]) -> list[Path]:
    """Files of suites by path or name; raises pytest.UsageError for one that is not there, and on
    systems without file locks."""
    if fcntl is None:
        raise pytest.UsageError(
            "--sysid-suite needs the file locks of Linux or macOS; use 'sysid-bench run SUITE "
            "--baseline FILE' here."
        )
    try:
        return [Path(suite(str(_from_root(config, name)))).resolve() for name in named]
    except SysidBenchError as error:
        raise pytest.UsageError(str(error)) from error


def _from_root(config: pytest.Config, name: str) -> Path | str:
    """A file named in the configuration lies below the root of the tests."""
    below = config.rootpath / name
    return below if below.is_file() else name


def suite_file(file: Path, parent: pytest.Collector) -> "_SuiteFile":
    """The collector of a suite."""
    if file.is_relative_to(parent.config.rootpath):
        return _SuiteFile.from_parent(parent, path=file)
    # Built-in suites lie elsewhere, where pytest leaves the file out of the names of items.
    return _SuiteFile.from_parent(parent, path=file, nodeid=file.name)


class _SuiteFile(pytest.File):
    """A suite; its items are its cells, in the order of its experiments."""

    def collect(self) -> Iterator["_CellItem"]:
        """Yield one item per cell."""
        try:
            cells = plan(self.path).cells
            named = self.config.getoption("--sysid-baseline")
            files = named or self.config.getini("sysid_baselines")
            found = [read_baseline(_from_root(self.config, file)) for file in files]
            run = _Run(self.config, self.path, {baseline.run.name: baseline for baseline in found})
        except SysidBenchError as error:
            raise self.CollectError(str(error)) from error
        for cell, name in zip(cells, _names(cells), strict=True):
            item: _CellItem = _CellItem.from_parent(self, name=name, cell=cell, run=run)
            item.add_marker(pytest.mark.sysid_cell)
            # With --dist loadgroup the cells of one experiment stay in one process.
            item.add_marker(pytest.mark.xdist_group(cell.experiment))
            yield item


def _names(cells: Sequence[Cell]) -> list[str]:
    """ "ur5[none-exact-ols-0]": robot and the labels that tell cells apart; unique."""
    heads = [cell.first_fields for cell in cells]
    axes = label_axes(heads)
    names = [
        f"{head['robot']}[{'-'.join(str(head[axis]) for axis in axes)}]".replace(" ", "_")
        for head in heads
    ]
    count: dict[str, int] = {}
    for name in names:
        count[name] = count.get(name, 0) + 1
    return [
        name if count[name] == 1 else f"{name}-{cell.id[:6]}"
        for name, cell in zip(names, cells, strict=True)
    ]


class _CellFailure(Exception):
    """A cell that is not ok, or worse than its baseline."""


class _CellItem(pytest.Item):
    """The test of one cell."""

    def __init__(self, *, cell: Cell, run: "_Run", **given: Any) -> None:
        super().__init__(**given)
        self.cell, self.run = cell, run

    def runtest(self) -> None:
        """Wait for the row of the cell; fail where it is not ok, or worse than the baseline."""
        row = self.run.wait_for(self.cell.id, _selected(self.session, self.run))
        if row is None:
            raise _CellFailure(f"The run ended without a row of this cell.\n{self.run.log}")
        baseline = self.run.baseline
        is_known = baseline is not None and baseline.run.has_cell(self.cell.first_fields)
        if row["status"] in _SKIPPED and not is_known:
            pytest.skip(str(row.get("reason") or row["status"]))
        text = cell_text(self.cell, row, baseline, RunFolder(self.run.folder))
        if text:
            raise _CellFailure(text)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """The row and the command that reproduces it, without a traceback of the plug-in."""
        if isinstance(excinfo.value, _CellFailure):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Place and name in reports."""
        return self.path, None, self.name


def _selected(session: pytest.Session, run: "_Run") -> list[str]:
    """Ids of the collected cells of a run; equal in all processes of xdist."""
    return [
        item.cell.id for item in session.items if isinstance(item, _CellItem) and item.run is run
    ]


@dataclass(eq=False)
class _Run:
    """The run of a suite that the items of a session share, in a folder of the cache of pytest.

    The process that finds nobody running starts the run, which holds the lock until its end. Files
    beside the folder: `.lock`, `.log`, `.json` (what is run), `.session` (for which session).
    """

    config: pytest.Config
    suite: Path
    baselines: Mapping[str, Baseline]

    @cached_property
    def folder(self) -> Path:
        """Run folder; that of an earlier session is replaced."""
        # `-p no:cacheprovider` leaves out the plug-in that sets this attribute.
        cache = getattr(self.config, "cache", None)
        base = Path(cache.mkdir("sysid-bench")) if cache else Path(".pytest-sysid-bench")
        base.mkdir(exist_ok=True)
        return base / self.suite.stem

    @cached_property
    def session(self) -> str:
        """Name of this session, the same in all processes of xdist."""
        given: Mapping[str, Any] = getattr(self.config, "workerinput", {})
        return str(given.get("testrunuid") or uuid.uuid4().hex)

    @cached_property
    def rows(self) -> NewRows:
        """Rows of this session."""
        return NewRows(self.folder)

    @cached_property
    def baseline(self) -> Baseline | None:
        """Baseline of this suite."""
        return self.baselines.get(RunFolder(self.folder).suite.name)

    @property
    def log(self) -> str:
        """The last lines that the run printed."""
        with contextlib.suppress(OSError):
            return self._beside("log").read_text(errors="replace")[-2000:]
        return ""

    def wait_for(self, cell: str, selected: Sequence[str]) -> Row | None:
        """Row of a cell, when it is written; None where the run has ended without it."""
        while True:
            with self._lock() as lock:
                is_ours = self._is_of_this_session()
                if lock is not None and not is_ours:
                    self._start(selected, lock)
                if is_ours:
                    self.rows.update()
                    # The lock is free: the run has ended, and no further row comes.
                    if cell in self.rows.rows or lock is not None:
                        return self.rows.rows.get(cell)
            time.sleep(_POLL_SECONDS)

    def _is_of_this_session(self) -> bool:
        with contextlib.suppress(OSError):
            return self._beside("session").read_text() == self.session
        return False

    def _beside(self, suffix: str) -> Path:
        return self.folder.with_name(f"{self.folder.name}.{suffix}")

    @contextlib.contextmanager
    def _lock(self) -> Iterator[int | None]:
        """The descriptor of the lock; None while a run holds it."""
        descriptor = os.open(self._beside("lock"), os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield descriptor
        except BlockingIOError:
            yield None
        finally:
            os.close(descriptor)

    def _start(self, selected: Sequence[str], lock: int) -> None:
        """Start the run of the selected cells in an empty folder; it inherits the lock."""
        shutil.rmtree(self.folder, ignore_errors=True)
        is_worker = hasattr(self.config, "workerinput")
        task = {
            "suite": str(self.suite),
            "folder": str(self.folder),
            "cells": list(selected),
            "jobs": int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")),
            # Workers of xdist may end early; their parent is the session.
            "guard": os.getppid() if is_worker else os.getpid(),
        }
        file = self._beside("json")
        file.write_text(json.dumps(task))
        with self._beside("log").open("wb") as log:
            # A process of its own, which holds the lock: items see by it that the run goes on.
            runner = subprocess.Popen(
                [sys.executable, "-m", "sysid_bench.pytest_suite", str(file)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, pass_fds=(lock,),
            )  # fmt: skip
        # A worker that has no item left must not end the run for the others.
        if not is_worker:
            self.config.add_cleanup(lambda: _stop(runner))
        self._beside("session").write_text(self.session)


def _stop(runner: subprocess.Popen[bytes]) -> None:
    """End a run that goes on after the session, as after an interrupt or -x."""
    runner.terminate()
    runner.wait()


def _end_with(guard: int) -> None:
    """End this process, as SIGTERM does, when the process of the session is gone."""
    while True:
        time.sleep(_GUARD_SECONDS)
        try:
            os.kill(guard, 0)
        except OSError:
            os.kill(os.getpid(), signal.SIGTERM)
            return


def _main(task: Mapping[str, Any]) -> int:
    """Run the selected cells of a suite in this process."""
    threading.Thread(target=_end_with, args=(task["guard"],), daemon=True).start()
    # By ids: what -k or a path has left out does not run.
    chosen = ", ".join(f'"{cell}"' for cell in task["cells"])
    try:
        run_cells(
            task["suite"], Path(task["folder"]), jobs=task["jobs"], select=f"id in [{chosen}]"
        )
    except SysidBenchError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(_main(json.loads(Path(sys.argv[1]).read_text())))
