"""Pages of a site as text: index, suite versions, robots, methods, leaderboard.

Offline and without scripts; every name in them is escaped; the same text for the same runs.
"""

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from markupsafe import Markup

from sysid_bench.apps.site.suite_version import (
    SiteRun,
    SuiteVersion,
    group_by_version,
    page_name,
    result_notes,
)
from sysid_bench.evaluation.intervals import level_text, with_level
from sysid_bench.metrics import METRICS
from sysid_bench.reporting import html
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import figure, page_svg
from sysid_bench.reporting.ranking import MethodRatio, Ranking
from sysid_bench.reporting.ranking_figures import (
    cost_by_method,
    cost_figure,
    method_times,
    profile,
)
from sysid_bench.reporting.ranking_tables import ranking_tables, verdict_of, verdict_table
from sysid_bench.reporting.report_data import crosscheck_rows, failed_cells
from sysid_bench.reporting.sections import experiment_lines, plant_tables, source_tables
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.tables import Entry, Key, Table

_RANK = "rank"


def rank_table(ranking: Ranking) -> Table:
    """Rank of each method that has one, with its interval, for a figure."""
    verdicts = verdict_table(ranking)
    ranks = {row: verdicts.entry(row, (_RANK,)) for row in verdicts.rows}
    entries: dict[tuple[Key, Key], Entry] = {
        (row, ()): one for row, one in ranks.items() if one and one.value is not None
    }
    return Table(
        name=f"{ranking.name}-ranks",
        title=f"{ranking.title}: ranks",
        metrics=tuple(metric for metric in verdicts.metrics if metric.name == _RANK),
        stat="median",
        interval="ci95",
        row_fields=("estimator",),
        column_fields=(),
        rows=tuple(row for row, _ in entries),
        columns=((),),
        entries=entries,
        own_caption=f"Rank and its {level_text()} interval over robots drawn again; 1 is the best.",
    )


def score_tables(
    version: SuiteVersion,
    rows: str,
    columns: str = "plant",
    only: tuple[str, str] | None = None,
) -> Iterator[Table]:
    """Median error by two labels, of data with noise and of exact data; `only`: a label and the
    value that cells have."""
    metric = version.score
    if metric.level != METRICS["torque_error"].level or metric.text:
        return
    # Apart: a median over both would be of rounding or of noise, by the number of their cells.
    halves = {
        "Data with noise": version.with_noise(),
        "Exact data: errors are rounding": version.exact(),
    }
    for title, cells in halves.items():
        chosen = cells if only is None else cells[cells[only[0]].map(label) == only[1]]
        if len(chosen):
            spec = {
                "name": "scores",
                "title": title,
                "rows": [rows],
                "columns": [columns] if columns in chosen.columns else [],
                "cells": {"metric": metric.name, "interval": "iqr"},
            }
            yield build_table(chosen, spec, metrics=version.first.metrics)


SCHEMA: Final = 1
"""Version of the format."""
SCHEMA_FILE: Final = Path(__file__).with_name("leaderboard.schema.json")


def leaderboard(versions: Iterable[SuiteVersion]) -> dict[str, Any]:
    """The content of leaderboard.json: finite numbers, null where there is none."""
    return {"schema": SCHEMA, "suites": [_suite_entry(version) for version in versions]}


def _suite_entry(version: SuiteVersion) -> dict[str, Any]:
    counts, seconds = Counter(map(label, version.cells["status"])), method_times(version.cells)
    with version.level():
        rankings = [
            {
                "name": ranking.name,
                "title": ranking.title,
                "metric": ranking.metric.name,
                "against": ranking.against,
                "margin": ranking.margin,
                "methods": [_method(ranking, one, seconds) for one in ranking.comparisons],
            }
            for ranking in version.ranking_list
        ]
    return {
        "name": version.name,
        "version": version.version,
        "title": version.title,
        "seed": version.first.suite.get("seed"),
        "page": f"suites/{version.page}.html",
        "cells": dict(sorted(counts.items())),
        "runs": [_run(run) for run in version.runs],
        "rankings": rankings,
        "limitations": result_notes(version),
    }


def _run(run: SiteRun) -> dict[str, Any]:
    submission, checked = run.submission, run.checked
    return {
        "name": run.name,
        "package": run.package,
        "commit": run.code_version or None,
        "cpu": run.env.get("cpu"),
        "planned": run.planned,
        "rows": len(run.cells),
        "submission": None if submission is None else dict(vars(submission)),
        "checked": None if checked is None else {**vars(checked), "cells": list(checked.cells)},
    }


def _method(ranking: Ranking, one: MethodRatio, seconds: Mapping[str, float]) -> dict[str, Any]:
    rank, low, high = ranking.rank_interval.get(one.method, (math.nan,) * 3)
    return {
        "method": one.method,
        "same_as": ranking.same.get(one.method),
        "rank": _finite(rank),
        "rank_interval": _pair(low, high),
        "ratio": one.ratio.value,
        "ratio_interval": _pair(one.ratio.low, one.ratio.high),
        "fallback": one.fallback.value,
        "fallback_interval": _pair(one.fallback.low, one.fallback.high),
        "cells": one.cells,
        "failed": one.failed,
        "robots": one.robots,
        "p": _finite(one.p),
        "p_holm": _finite(ranking.corrected.get(one.method, (math.nan,) * 2)[0]),
        "verdict": verdict_of(ranking, one),
        "cpu_seconds": seconds.get(one.method),
    }


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _pair(low: float | None, high: float | None) -> list[float] | None:
    ends = _finite(low), _finite(high)
    return None if ends[0] is None or ends[1] is None else [ends[0], ends[1]]


LEADERBOARD: Final = "leaderboard.json"
"""The file that makes a folder a site."""
_FOLDERS: Final = (Path(__file__).parent, Path(html.__file__).parent)
_RANKS: Final = "Ranks with 95 % intervals over robots drawn again; 1 is the best."


def site_pages(runs: Sequence[SiteRun]) -> dict[str, str]:
    """Text of every file of the site of some runs, by path."""
    versions = group_by_version(runs)
    robots, methods = _names(versions, "robot"), _names(versions, "estimator")
    every = pd.concat([version.cells for version in versions], ignore_index=True)
    index = {
        "versions": [_summary(version) for version in versions],
        "robots": robots,
        "methods": methods,
        "sources": list(source_tables(every)),
        "submissions": [run for one in versions for run in one.runs if run.submission is not None],
    }
    pages = {
        "index.html": _render("index", "", index),
        # allow_nan=False: a NaN is an error here, and not in the programs that read the file.
        LEADERBOARD: json.dumps(leaderboard(versions), indent=1, allow_nan=False) + "\n",
        SCHEMA_FILE.name: SCHEMA_FILE.read_text(encoding="utf-8"),
    }
    for version in versions:
        with version.level():
            page = _render("suite", "../", _suite_page(version))
        pages[f"suites/{version.page}.html"] = page
    for kind, names, part in (("Robot", robots, _robot_part), ("Method", methods, _method_part)):
        for name in names:
            parts = [found for version in versions if (found := part(version, name))]
            page = _render("part", "../", {"kind": kind, "name": name, "parts": parts})
            pages[f"{kind.lower()}s/{page_name(name)}.html"] = page
    return pages


def _render(template: str, up: str, values: Mapping[str, Any]) -> str:
    """A page; `up` leads to the index."""
    always = {"up": up, "page_name": page_name, "leaderboard": LEADERBOARD}
    return html.page_layout(f"{template}.html.jinja", *_FOLDERS).render({**always, **values})


def _names(versions: Iterable[SuiteVersion], field: str) -> list[str]:
    """Distinct labels of the cells of all versions, sorted."""
    return sorted({name for version in versions for name in map(label, version.cells[field])})


def _summary(version: SuiteVersion) -> dict[str, Any]:
    """Entry of the index; `first` names the methods whose rank may be the first: those with the
    lowest lower end of its interval; none for few robots, which have no interval."""
    cells, first = version.cells, []
    with version.level():
        for ranking in version.ranking_list:
            ends = {name: low for name, (_, low, _) in ranking.rank_interval.items()}
            lows = {name: low for name, low in ends.items() if np.isfinite(low)}
            leaders = [name for name, low in lows.items() if low <= min(lows.values())]
            first.append((ranking.title, leaders))
    return {
        "version": version,
        "counts": _counts(cells),
        "robots": cells["robot"].map(label).nunique(),
        "methods": cells["estimator"].map(label).nunique(),
        "first": first,
    }


def _counts(cells: pd.DataFrame) -> str:
    counts = Counter(map(label, cells["status"]))
    return ", ".join(f"{count} {status}" for status, count in counts.most_common())


def _suite_page(version: SuiteVersion) -> dict[str, Any]:
    cells = version.cells
    orders = [ranking_tables(ranking) for ranking in version.ranking_list]
    return {
        "version": version,
        "counts": _counts(cells),
        "limitations": result_notes(version),
        "rankings": [order[0] for order in orders],
        "details": [table for order in orders for table in order[1:]],
        "figures": [(title, Markup(page_svg(svg))) for title, svg in _figures(version)],
        "scores": list(score_tables(version, "robot", "estimator")),
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
            yield f"{ranking.title}. {with_level(_RANKS)}", figure.svg(ranks)
        yield f"{ranking.title}. {html.PROFILE}", profile.svg(ranking)
        if cost_by_method(ranking, version.cells):
            title = f"{ranking.title}. Error against CPU time. {html.COST}"
            yield title, cost_figure.svg(ranking, version.cells)
    for table in plant_tables(version.with_noise()):
        yield f"Levels. {table.description}", figure.svg(table)


def _robot_part(version: SuiteVersion, name: str) -> dict[str, Any]:
    """Section on a robot; {} where the version lacks it. Ranks are of methods; a robot has none."""
    cells = version.cells[version.cells["robot"].map(label) == name]
    tables = score_tables(version, "estimator", only=("robot", name))
    return _part(version, cells, tables, [], crosscheck_rows(cells)) if len(cells) else {}


def _method_part(version: SuiteVersion, name: str) -> dict[str, Any]:
    """Section on a method; {} where the version lacks it."""
    cells = version.cells[version.cells["estimator"].map(label) == name]
    with version.level():
        places = [
            {"title": ranking.title, "text": _place(ranking, name)}
            for ranking in version.ranking_list
            if name in ranking.method_names
        ]
    tables = score_tables(version, "robot", only=("estimator", name))
    return _part(version, cells, tables, places, []) if len(cells) else {}


def _part(
    version: SuiteVersion, cells: pd.DataFrame, tables: Iterable[Table], places: Any, checks: Any
) -> dict[str, Any]:
    return {
        "version": version,
        "counts": _counts(cells),
        "places": places,
        "tables": list(tables),
        "crosschecks": checks,
        "failures": failed_cells(cells),
    }


def _place(ranking: Ranking, method: str) -> str:
    if method in ranking.same:
        return f"same answers as {ranking.same[method]}"
    if method not in ranking.rank_interval:
        return "no rank"
    rank, low, high = ranking.rank_interval[method]
    interval = "" if np.isnan(low) else f" ({level_text()} interval {low:g} to {high:g})"
    return f"rank {rank:g} of {len(ranking.rank_interval)}{interval}"
