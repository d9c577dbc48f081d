"""CPU seconds that some cells are expected to take: from rows of earlier runs on this machine, else
from the table of cell.py."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Final

from sysid_bench.errors import SysidBenchError
from sysid_bench.harness.cell import Cell, cell_cost, run_cost
from sysid_bench.harness.stored_run import RunFolder

_RUNS: Final = 20
"""Earlier runs that are read, the latest first."""
_LARGEST: Final = 3.0
"""Most that earlier rows change what is in no earlier run: machines do not differ by more."""
_TIMES: Final = ("seconds_cpu", "seconds_experiment_cpu")
_FIELDS: Final = ("id", "experiment", "robot", "task", "simulation", "estimator", *_TIMES)

Key = tuple[str, ...]
_Samples = defaultdict[Key, list[float]]
_Part = tuple[float, float | None]
"""Seconds of a part of a run by the table, and by earlier rows."""


@dataclass(frozen=True)
class RunTime:
    """Expected CPU seconds of a whole run on one worker, processes and report included; `known`
    cells of it are from rows of earlier runs, of those in `runs` the same cells."""

    seconds: float
    cells: int
    known: int
    runs: tuple[str, ...]

    @property
    def source(self) -> str:
        """Origin of the estimate, in words."""
        if not self.known:
            return "from a table"
        rows = f"rows of {', '.join(self.runs)}" if self.runs else "rows of similar cells"
        return f"from {rows}" if self.known == self.cells else f"from {rows} and a table"


@dataclass(frozen=True)
class StoredTimes:
    """CPU seconds of earlier rows: medians of experiments and of estimators, each by id and by what
    it is alike in; `runs` has the folder of each cell, by id."""

    experiments: Mapping[Key, float] = field(default_factory=dict)
    estimators: Mapping[Key, float] = field(default_factory=dict)
    runs: Mapping[str, str] = field(default_factory=dict)


def stored_times(folders: Iterable[Path]) -> StoredTimes:
    """Read the times of the latest runs; a folder that cannot be read has none."""
    experiments, estimators = _Samples(list), _Samples(list)
    runs = dict[str, str]()
    for folder in sorted(folders, key=_age)[:_RUNS]:
        with suppress(SysidBenchError, OSError, ValueError, KeyError):
            cells = RunFolder.open(folder).frames().read("cells", _FIELDS)
            kept = cells[list(_FIELDS)].dropna()  # rows that have both times
            rows = [{str(k): v for k, v in row.items()} for row in kept.to_dict("records")]
            for row in rows:
                for key in _estimator_keys(row["id"], row):
                    estimators[key].append(row["seconds_cpu"])
            # Every cell states the time of its experiment, which all of them share: it counts once.
            for name, row in {row["experiment"]: row for row in rows}.items():
                for key in _experiment_keys(name, row):
                    experiments[key].append(row["seconds_experiment_cpu"])
            runs = {row["id"]: str(folder) for row in rows} | runs
    whole, each = ({k: median(v) for k, v in times.items()} for times in (experiments, estimators))
    return StoredTimes(whole, each, runs)


def _age(folder: Path) -> float:
    """The later a run was consolidated, the smaller."""
    try:
        return -(folder / "cells.parquet").stat().st_mtime
    except OSError:
        return 0.0


def _experiment_keys(identifier: str, row: Mapping[str, Any]) -> tuple[Key, ...]:
    """Keys by which an experiment is found, the closest first."""
    return (identifier,), (row["robot"], row["task"], row["simulation"])


def _estimator_keys(identifier: str, row: Mapping[str, Any]) -> tuple[Key, ...]:
    """Keys by which the work of an estimator is found, the closest first."""
    robot = (row["robot"], row["task"], row["simulation"], row["estimator"])
    return (identifier,), robot, (row["estimator"],)


def run_time(cells: Sequence[Cell], earlier: StoredTimes) -> RunTime:
    """Return the expected time of some cells.

    What earlier rows do not have is from the table, times the ratio of their times to the table.
    """
    parts, known = list[_Part](), 0
    experiments = set[str]()
    for cell in cells:
        cost = cell_cost(cell.spec, cell.estimator)
        keys = _estimator_keys(cell.id, cell.labels)
        found = _first(earlier.estimators, keys)
        parts.append((cost.estimator, found))
        known += found is not None
        if cell.experiment not in experiments:
            experiments.add(cell.experiment)
            keys = _experiment_keys(cell.experiment, cell.labels)
            parts.append((cost.experiment, _first(earlier.experiments, keys)))
    robots = {(cell.labels["robot"], cell.labels["payload"]) for cell in cells}
    # Earlier times over those of the table, 1 without any.
    both = [(table, found) for table, found in parts if found is not None]
    of_table, of_rows = map(sum, zip(*both, strict=True)) if both else (0.0, 0.0)
    ratio = 1.0
    if of_table > 0 and of_rows > 0:
        ratio = min(max(of_rows / of_table, 1 / _LARGEST), _LARGEST)
    seconds = (table * ratio if found is None else found for table, found in parts)
    total = run_cost(seconds, len(robots)) if cells else 0.0
    runs = sorted({earlier.runs[cell.id] for cell in cells if cell.id in earlier.runs})
    return RunTime(total, len(cells), known, tuple(runs))


def _first(times: Mapping[Key, float], keys: Iterable[Key]) -> float | None:
    return next((times[key] for key in keys if key in times), None)
