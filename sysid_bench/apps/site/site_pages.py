"""Pages of a site as text: index, suite versions, robots, methods, leaderboard. Offline and without
scripts; every name in them is escaped; the same text for the same runs."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from markupsafe import Markup

from sysid_bench.apps.site.leaderboard import SCHEMA_FILE, leaderboard_text
from sysid_bench.apps.site.page_names import page_name
from sysid_bench.apps.site.result_notes import result_notes
from sysid_bench.apps.site.site_run import SiteRun
from sysid_bench.apps.site.site_tables import (
    median_tables,
    method_tables,
    rank_table,
    robot_tables,
)
from sysid_bench.apps.site.suite_version import SuiteVersion, group_by_version
from sysid_bench.evaluation.intervals import LEVEL_TEXT
from sysid_bench.reporting import html
from sysid_bench.reporting.figures import figure_svg, page_svg
from sysid_bench.reporting.ranking import Ranking
from sysid_bench.reporting.ranking_figures import cost_svg, profile_svg
from sysid_bench.reporting.ranking_tables import ranking_tables
from sysid_bench.reporting.report_data import crosscheck_rows, failed_cells
from sysid_bench.reporting.sections import experiment_lines, plant_tables, source_tables
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.tables import Table

LEADERBOARD: Final = "leaderboard.json"
"""The file that makes a folder a site."""
_FOLDERS: Final = (Path(__file__).parent, Path(html.__file__).parent)
_RANKS: Final = f"Ranks with {LEVEL_TEXT} intervals over robots drawn again; 1 is the best."


def site_pages(runs: Sequence[SiteRun]) -> dict[str, str]:
    """Text of every file of the site of some runs, by path."""
    versions = group_by_version(runs)
    robots, methods = _names(versions, "robot"), _names(versions, "estimator")
    pages = {
        "index.html": _render("index", "", _index(versions, robots, methods)),
        LEADERBOARD: leaderboard_text(versions),
        SCHEMA_FILE.name: SCHEMA_FILE.read_text(encoding="utf-8"),
    }
    for version in versions:
        pages[f"suites/{version.page}.html"] = _render("suite", "../", _suite(version))
    for name in robots:
        parts = _parts(versions, "robot", name, robot_tables)
        pages[f"robots/{page_name(name)}.html"] = _part("Robot", name, parts)
    for name in methods:
        parts = _parts(versions, "estimator", name, method_tables)
        pages[f"methods/{page_name(name)}.html"] = _part("Method", name, parts)
    return pages


def _part(kind: str, name: str, parts: Iterable[Mapping[str, Any]]) -> str:
    """Page on a robot or a method."""
    return _render("part", "../", {"kind": kind, "name": name, "parts": list(parts)})


def _render(template: str, up: str, values: Mapping[str, Any]) -> str:
    """A page; `up` leads to the index."""
    always = {"up": up, "page_name": page_name, "leaderboard": LEADERBOARD}
    return html.page_layout(f"{template}.html.jinja", *_FOLDERS).render({**always, **values})


def _names(versions: Iterable[SuiteVersion], field: str) -> list[str]:
    """Distinct labels of the cells of all versions, sorted."""
    return sorted({name for version in versions for name in map(label, version.cells[field])})


def _index(
    versions: Sequence[SuiteVersion], robots: Sequence[str], methods: Sequence[str]
) -> dict[str, Any]:
    cells = pd.concat([version.cells for version in versions], ignore_index=True)
    entries = [run for version in versions for run in version.runs if run.submission is not None]
    return {
        "versions": [_summary(version) for version in versions],
        "robots": robots,
        "methods": methods,
        "sources": list(source_tables(cells)),
        "submissions": entries,
    }


def _summary(version: SuiteVersion) -> dict[str, Any]:
    cells = version.cells
    return {
        "version": version,
        "counts": _counts(cells),
        "robots": cells["robot"].map(label).nunique(),
        "methods": cells["estimator"].map(label).nunique(),
        "first": [(one.title, _leaders(one)) for one in version.ranking_list],
    }


def _counts(cells: pd.DataFrame) -> str:
    counts = Counter(map(label, cells["status"]))
    return ", ".join(f"{count} {status}" for status, count in counts.most_common())


def _leaders(ranking: Ranking) -> list[str]:
    """Methods whose rank may be the first: those with the lowest lower end of its interval; none
    for few robots, which have no interval."""
    lows = {name: low for name, (_, low, _) in ranking.rank_interval.items() if np.isfinite(low)}
    return [name for name, low in lows.items() if low <= min(lows.values())]


def _suite(version: SuiteVersion) -> dict[str, Any]:
    cells = version.cells
    orders = [ranking_tables(ranking) for ranking in version.ranking_list]
    return {
        "version": version,
        "counts": _counts(cells),
        "limitations": result_notes(version),
        "rankings": [order[0] for order in orders],
        "details": [table for order in orders for table in order[1:]],
        "figures": [(title, Markup(page_svg(svg))) for title, svg in _figures(version)],
        "scores": list(median_tables(version)),
        "levels": list(plant_tables(version.with_noise())),
        "sources": list(source_tables(cells)),
        "crosschecks": crosscheck_rows(cells),
        "failures": failed_cells(cells),
        "assumptions": experiment_lines(version.first.suite, cells),
        "robots": _names([version], "robot"),
        "methods": _names([version], "estimator"),
    }


def _figures(version: SuiteVersion) -> Iterator[tuple[str, str]]:
    """Title and <svg> of ranks, profile and cost of every ranking, and of the levels."""
    for ranking in version.ranking_list:
        ranks = rank_table(ranking)
        if ranks.rows:
            yield f"{ranking.title}. {_RANKS}", figure_svg(ranks)
        yield f"{ranking.title}. {html.PROFILE}", profile_svg(ranking)
        cost = cost_svg(ranking, version.cells)
        if cost:
            yield f"{ranking.title}. Error against CPU time. {html.COST}", cost
    for table in plant_tables(version.with_noise()):
        yield f"Levels. {table.description}", figure_svg(table)


def _parts(
    versions: Iterable[SuiteVersion],
    field: str,
    name: str,
    tables_of: Callable[[SuiteVersion, str], Iterable[Table]],
) -> Iterator[dict[str, Any]]:
    """Sections on a robot or a method, one for each suite version that has it."""
    for version in versions:
        cells = version.cells[version.cells[field].map(label) == name]
        if len(cells):
            yield {
                "version": version,
                "counts": _counts(cells),
                "places": _places(version, name) if field == "estimator" else [],
                "tables": list(tables_of(version, name)),
                "crosschecks": crosscheck_rows(cells) if field == "robot" else [],
                "failures": failed_cells(cells),
            }


def _places(version: SuiteVersion, method: str) -> list[Mapping[str, str]]:
    """Rank and verdict of a method in each ranking of a version."""
    return [
        {"title": ranking.title, "text": _place(ranking, method)}
        for ranking in version.ranking_list
        if method in ranking.method_names
    ]


def _place(ranking: Ranking, method: str) -> str:
    if method in ranking.same:
        return f"same answers as {ranking.same[method]}"
    if method not in ranking.rank_interval:
        return "no rank"
    rank, low, high = ranking.rank_interval[method]
    interval = "" if np.isnan(low) else f" ({LEVEL_TEXT} interval {low:g} to {high:g})"
    return f"rank {rank:g} of {len(ranking.rank_interval)}{interval}"
