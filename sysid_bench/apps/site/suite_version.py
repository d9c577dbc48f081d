"""Version of a suite: all runs of it, with their cells together."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import pandas as pd

from sysid_bench.apps.site.page_names import page_name
from sysid_bench.apps.site.site_run import SiteRun
from sysid_bench.errors import UsageError
from sysid_bench.metrics import metric_of
from sysid_bench.reporting.figures import EXACT
from sysid_bench.reporting.ranking import Ranking, entry_with_cells, rank_cells
from sysid_bench.reporting.sections import SCORE
from sysid_bench.reporting.selection import label
from sysid_bench.words import REFERENCE

if TYPE_CHECKING:
    from sysid_bench.types import Metric

_DEFAULT: Final[Mapping[str, Any]] = {"name": "methods", "metric": SCORE}
"""Ranking of a suite that names none; against the reference, else the first method."""


@dataclass(frozen=True, eq=False)
class SuiteVersion:
    """Runs of one suite that may be compared; of cells in several runs the first holds."""

    runs: tuple[SiteRun, ...]

    @property
    def name(self) -> str:
        """Name of the suite."""
        return str(self.first.suite.get("name") or self.first.name)

    @property
    def title(self) -> str:
        """Title of the suite, else its name."""
        return str(self.first.suite.get("title") or self.name)

    @property
    def version(self) -> str:
        """8 hex digits, see `SiteRun.version`."""
        return self.first.version

    @property
    def page(self) -> str:
        """Name of its page, without folder and suffix."""
        return page_name(f"{self.name}-{self.version}")

    @property
    def first(self) -> SiteRun:
        """The run whose suite gives title, tables and rankings."""
        return self.runs[0]

    @property
    def planned(self) -> int:
        """Cells of all plans; those that several runs plan count in each."""
        return sum(run.planned for run in self.runs)

    @cached_property
    def cells(self) -> pd.DataFrame:
        """Cells of all runs, each id once."""
        kept = pd.concat([run.cells for run in self.runs], ignore_index=True)
        return kept.drop_duplicates("id", ignore_index=True)

    @cached_property
    def score(self) -> "Metric":
        """The metric of pages on a robot or a method: of held-out torque, else of the first table
        of the suite."""
        scored = SCORE in self.cells and self.cells[SCORE].notna().any()
        tables = () if scored else self.first.suite.get("table") or ()
        named = chain.from_iterable(_metrics(table) for table in tables)
        return metric_of(next(named, SCORE), self.first.metrics)

    @cached_property
    def ranking_list(self) -> tuple[Ranking, ...]:
        """Rankings of the first run's suite over the cells of all; a family that names methods
        stays theirs."""
        written = self.first.suite.get("ranking") or [self._default_ranking()]
        return tuple(chain.from_iterable(map(self._ranked, written)))

    def _default_ranking(self) -> dict[str, Any]:
        methods = list(dict.fromkeys(self.cells["estimator"].map(label)))
        against = REFERENCE if REFERENCE in methods else methods[0]
        return {**_DEFAULT, "against": against}

    def _ranked(self, entry: Mapping[str, Any]) -> Iterator[Ranking]:
        """Rankings of an entry, with the members of its family that have cells; none where the
        cells so far cannot be ranked."""
        own = entry_with_cells(entry, self.cells)
        try:
            found = list(rank_cells(self.cells, own, self._choose, self.first.metrics))
        except UsageError:
            return
        yield from (one for one in found if one.cases.with_ratio.any())

    @cached_property
    def _run_of(self) -> dict[str, SiteRun]:
        """The run that a cell is shown of, by id."""
        return {name: run for run in reversed(self.runs) for name in run.cells["id"]}

    def _choose(self, expression: str, row: Mapping[str, Any]) -> bool:
        """Test of a condition on a row, with the plan of its own run."""
        return self._run_of[row["id"]].choose(expression, row)

    def with_noise(self) -> pd.DataFrame:
        """Cells whose data have noise; recorded ones have."""
        return self.cells[~self._is_exact]

    def exact(self) -> pd.DataFrame:
        """Cells of exact data, whose errors are rounding."""
        return self.cells[self._is_exact]

    @property
    def _is_exact(self) -> "pd.Series[bool]":
        noise = self.cells.get("noise", pd.Series("", index=self.cells.index))
        return noise.map(label) == EXACT


def _metrics(table: Mapping[str, Any]) -> tuple[str, ...]:
    named = (table.get("cells") or {}).get("metric")
    return (str(named),) if named else tuple(map(str, table.get("metrics") or ()))


def group_by_version(runs: Iterable[SiteRun]) -> tuple[SuiteVersion, ...]:
    """Runs by name and version of their suite, sorted; within one in the given order. Where a label
    names another method than in an earlier run, the run's name joins it."""
    groups: dict[tuple[str, str], list[SiteRun]] = {}
    for run in runs:
        groups.setdefault((str(run.suite.get("name") or run.name), run.version), []).append(run)
    return tuple(SuiteVersion(tuple(_with_labels(groups[key]))) for key in sorted(groups))


def _with_labels(runs: Iterable[SiteRun]) -> Iterator[SiteRun]:
    known: dict[str, str] = {}
    for run in runs:
        other = {
            name: f"{name} ({run.name})"
            for name, method in run.methods.items()
            if known.get(name, method) != method
        }
        known |= {other.get(name, name): method for name, method in run.methods.items()}
        names = run.cells["estimator"].map(lambda name, other=other: other.get(name, name))
        yield replace(run, cells=run.cells.assign(estimator=names)) if other else run
