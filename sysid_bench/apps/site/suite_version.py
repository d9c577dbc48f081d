"""Runs and submissions as a site shows them: by version of their suite, with their limitations."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.errors import UsageError
from sysid_bench.evaluation.intervals import LEVEL, ROBOTS, at_level
from sysid_bench.metrics import METRICS, metric_of
from sysid_bench.reporting.figures import EXACT
from sysid_bench.reporting.ranking import (
    Ranking,
    correct_together,
    entry_with_cells,
    rank_cells,
)
from sysid_bench.reporting.sections import SCORE
from sysid_bench.reporting.selection import Choose, label, metric_names
from sysid_bench.types import Metric
from sysid_bench.words import RECORDED, REFERENCE, STATUSES

if TYPE_CHECKING:
    import pandas as pd


_LONGEST: Final = 60


def page_name(text: str) -> str:
    """Lower-case letters, digits, dashes and underscores, with 6 hex digits of the text where
    that is another text: two names have two pages on any disk."""
    plain = re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-")[:_LONGEST]
    if plain == text:
        # Nothing was replaced: links to old pages stay.
        return plain
    # File names that differ by case alone are one file on some disks.
    return f"{plain or 'page'}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


_OF_ENTRANTS: Final = (
    "title", "estimator", "table", "ranking", "claim", "paper", "macro", "record", "origin",
    "metric",
)  # fmt: skip
"""Keys of a suite in which runs of one version may differ: who takes part, and what is shown."""
_OF_MACHINES: Final = ("timeout", "memory", "threads")


@dataclass(frozen=True)
class Submission:
    """Content of submission.toml: `name` of the entry, its `authors`, a `url` and `notes`; any may
    be empty."""

    name: str = ""
    authors: str = ""
    url: str = ""
    notes: str = ""


@dataclass(frozen=True)
class RepeatShare:
    """Cells of a submission that were run again and gave the same values: `cells` of the `drawable`
    ones, drawn with `seed`."""

    seed: int
    drawable: int
    cells: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SiteRun:
    """Rows of a run. `methods`: the estimator behind each label, as JSON; `rankings`: its entries;
    `sealed`: labels of plants whose sizes are secret; `notes` on rows of other code; `models`: hash
    of the canonical model of each robot."""

    name: str
    suite: Mapping[str, Any]
    env: Mapping[str, Any]
    cells: "pd.DataFrame"
    planned: int
    choose: Choose
    methods: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, Metric] = field(default_factory=lambda: METRICS)
    sealed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    submission: Submission | None = None
    checked: RepeatShare | None = None
    models: Mapping[str, str] = field(default_factory=dict)

    @property
    def version(self) -> str:
        """8 hex digits of what is measured: the suite without its methods and tables, and the
        content of its robots. Runs with the same name and version may be compared."""
        kept = {key: value for key, value in self.suite.items() if key not in _OF_ENTRANTS}
        limits = kept.get("run") or {}
        if kept.get("confidence") == LEVEL:  # versions are older than the key
            del kept["confidence"]
        # Limits of machines change no value; repeats do, and stay.
        kept["run"] = {key: value for key, value in limits.items() if key not in _OF_MACHINES}
        # Runs of before state no model, and are of another version than those of now.
        return canonical_hash([kept, dict(self.models)] if self.models else kept)[:8]

    @property
    def code_version(self) -> str:
        """Commit of the package that made the rows; "" where it is unknown."""
        git = self.env.get("git") or {}
        changed = " with changes" if git.get("dirty") else ""
        return f"{str(git['commit'])[:12]}{changed}" if git.get("commit") else ""

    @property
    def package(self) -> str:
        """Version of the package that made the rows."""
        return str((self.env.get("versions") or {}).get("sysid-bench") or "unknown")


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
    def cells(self) -> "pd.DataFrame":
        """Cells of all runs, each id once."""
        import pandas as pd

        # The first run of a cell counts: a later submission cannot replace its row.
        kept = pd.concat([run.cells for run in self.runs], ignore_index=True)
        return kept.drop_duplicates("id", ignore_index=True)

    @cached_property
    def score(self) -> "Metric":
        """The metric of pages on a robot or a method: of held-out torque, else of the first table
        of the suite."""
        scored = SCORE in self.cells and self.cells[SCORE].notna().any()
        tables = () if scored else self.first.suite.get("table") or ()
        named = chain.from_iterable(map(metric_names, tables))
        return metric_of(next(named, SCORE), self.first.metrics)

    def level(self) -> AbstractContextManager[None]:
        """Return the context in which intervals have the level of the suite."""
        return at_level(self.first.suite.get("confidence"))

    @cached_property
    def ranking_list(self) -> tuple[Ranking, ...]:
        """Rankings of the first run's suite over the cells of all; a family that names methods
        stays theirs."""
        methods = list(dict.fromkeys(self.cells["estimator"].map(label)))
        # The reference need not take part in a suite of somebody else.
        against = REFERENCE if REFERENCE in methods else methods[0]
        written = self.first.suite.get("ranking") or [{**_DEFAULT, "against": against}]
        # The run that a cell is shown of: conditions on its row are read with the plan of that run.
        run_of = {name: run for run in reversed(self.runs) for name in run.cells["id"]}

        def choose(expression: str, row: Mapping[str, Any]) -> bool:
            return run_of[row["id"]].choose(expression, row)

        found: list[Ranking] = []
        for entry in written:
            own = entry_with_cells(entry, self.cells)
            with self.level(), suppress(UsageError):  # the cells so far may have no ranking
                found += list(rank_cells(self.cells, own, choose, self.first.metrics))
        return correct_together(one for one in found if one.cases.with_ratio.any())

    def with_noise(self) -> "pd.DataFrame":
        """Cells whose data have noise; recorded ones have."""
        return self.cells[~self._is_exact]

    def exact(self) -> "pd.DataFrame":
        """Cells of exact data, whose errors are rounding."""
        return self.cells[self._is_exact]

    @property
    def _is_exact(self) -> "pd.Series[bool]":
        import pandas as pd

        noise = self.cells.get("noise", pd.Series("", index=self.cells.index))
        return noise.map(label) == EXACT


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
        # `other` as a default: a lambda in a loop would see the last one.
        names = run.cells["estimator"].map(lambda name, other=other: other.get(name, name))
        yield replace(run, cells=run.cells.assign(estimator=names)) if other else run


def result_notes(version: SuiteVersion) -> list[str]:
    """Sentences on missing cells, few robots, other machines, sealed plants and simulated data."""
    return [*_of_cells(version), *_of_rankings(version), *_of_runs(version)]


def _of_cells(version: SuiteVersion) -> Iterator[str]:
    cells = version.cells
    counts = Counter(map(label, cells["status"]))
    lost = ", ".join(f"{counts[name]} {name}" for name in STATUSES if name != "ok" and counts[name])
    if lost:
        yield f"{len(cells) - counts['ok']} of {len(cells)} cells have no result: {lost}."
    for run in version.runs:
        if run.planned > len(run.cells):
            yield f"{run.planned - len(run.cells)} planned cells of {run.name} have no row."
    recorded = int((cells["plant"].map(label) == RECORDED).sum()) if "plant" in cells else 0
    if not recorded:
        yield "All data are simulated; no real robot was measured."
    elif recorded == len(cells):
        yield "All data are recorded: true parameters are unknown, and errors are of torques alone."
    failed = cells[cells["crosscheck"] == "failed"] if "crosscheck" in cells else cells[:0]
    if len(failed):
        robots = ", ".join(dict.fromkeys(map(label, failed["robot"])))
        yield f"The two engines do not agree on {robots}."


def _of_rankings(version: SuiteVersion) -> Iterator[str]:
    if not version.ranking_list:
        yield "Methods are not ranked: fewer than two have an error on data with noise."
    for ranking in version.ranking_list:
        title, robots = ranking.title, max((one.robots for one in ranking.comparisons), default=0)
        if robots < ROBOTS.fewest:
            least = ROBOTS.fewest
            yield f"{title}: {robots} robots; ranks and ratios have no interval below {least}."
        if ranking.same:
            same = ", ".join(f"{name} = {first}" for name, first in ranking.same.items())
            yield f"{title}: methods with the same answers share a place: {same}."


def _of_runs(version: SuiteVersion) -> Iterator[str]:
    runs = version.runs
    if len({str(run.env.get("cpu")) for run in runs}) > 1:
        yield "The runs are of several processors: CPU times of their methods are not comparable."
    if len({run.code_version for run in runs}) > 1:
        yield "The runs are of several commits of the package."
    sealed = sorted(set().union(*(run.sealed for run in runs)))
    if sealed:
        yield f"Sizes of {', '.join(sealed)} are sealed: a maintainer keeps their seed."
    for run in runs:
        yield from (f"{run.name}: {note}" for note in run.notes)
        if run.submission is not None and run.checked is None:
            yield f"{run.name} is a submission that was not checked."
