"""Limitations of the results of a suite version, as sentences."""

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sysid_bench.apps.site.site_run import SiteRun
from sysid_bench.apps.site.suite_version import SuiteVersion
from sysid_bench.evaluation.intervals import ROBOTS
from sysid_bench.reporting.ranking import Ranking
from sysid_bench.reporting.selection import label
from sysid_bench.words import RECORDED, STATUSES

if TYPE_CHECKING:
    import pandas as pd


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
    yield from _of_sources(cells)
    failed = cells[cells["crosscheck"] == "failed"] if "crosscheck" in cells else cells[:0]
    if len(failed):
        robots = ", ".join(dict.fromkeys(map(label, failed["robot"])))
        yield f"The two engines do not agree on {robots}."


def _of_sources(cells: "pd.DataFrame") -> Iterator[str]:
    recorded = int((cells["plant"].map(label) == RECORDED).sum()) if "plant" in cells else 0
    if not recorded:
        yield "All data are simulated; no real robot was measured."
    elif recorded == len(cells):
        yield "All data are recorded: true parameters are unknown, and errors are of torques alone."


def _of_rankings(version: SuiteVersion) -> Iterator[str]:
    if not version.ranking_list:
        yield "Methods are not ranked: fewer than two have an error on data with noise."
    for ranking in version.ranking_list:
        yield from (f"{ranking.title}: {text}" for text in _of_ranking(ranking))


def _of_ranking(ranking: Ranking) -> Iterator[str]:
    robots = max((one.robots for one in ranking.comparisons), default=0)
    if robots < ROBOTS.fewest:
        yield f"{robots} robots; ranks and ratios have no interval below {ROBOTS.fewest}."
    if ranking.same:
        same = ", ".join(f"{name} = {first}" for name, first in ranking.same.items())
        yield f"methods with the same answers share a place: {same}."


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
        yield from _of_run(run)


def _of_run(run: SiteRun) -> Iterator[str]:
    yield from (f"{run.name}: {note}" for note in run.notes)
    if run.submission is not None and run.checked is None:
        yield f"{run.name} is a submission that was not checked."
