"""Report of a run as one offline page: results, assumptions, failures, commands."""

import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.figures import figure_svg
from sysid_bench.reporting.listing import Listing
from sysid_bench.reporting.make_table import make_table
from sysid_bench.reporting.performance_profile import profile_svg
from sysid_bench.reporting.rankings import Ranking
from sysid_bench.reporting.report_data import (
    assumptions,
    cells_as_data,
    crosscheck_rows,
    environment_lines,
    failures,
    headline,
    joint_errors,
)
from sysid_bench.reporting.tables import Table
from sysid_bench.types import Metric

if TYPE_CHECKING:
    import pandas as pd

# Taller figures are not readable; the tables of the page hold the same numbers.
_MOST_ROWS_OF_A_FIGURE: Final = 45
PROFILE: Final = (
    "Performance profile: the share of cases in which a method's error is within so many times the "
    "smallest of the case; the first methods of the ranking in colour."
)


@dataclass(frozen=True, eq=False)
class RunView:
    """Data of a run for its report. `recordings` maps a cell's id to a path relative to the
    folder; `command` is what made the run; `joints` has a column `id` (or `cell`) and the joint
    fields of Score; `suite` and `env` are the run's TOML and environment as read."""

    folder: Path
    suite: Mapping[str, Any]
    env: Mapping[str, Any]
    cells: "pd.DataFrame"
    joints: "pd.DataFrame"
    tables: tuple[Table, ...]
    recordings: Mapping[str, str]
    command: str
    listings: tuple[Listing, ...] = ()
    pictures: tuple[tuple[str, str], ...] = ()  # title and <svg> of figures drawn elsewhere
    rankings: tuple[Ranking, ...] = ()
    metrics: Mapping[str, Metric] = field(default_factory=lambda: METRICS)


def write_report(run: RunView) -> Path:
    """Write `report.html` into the run's folder, whole or not at all; return its path."""
    path = run.folder / "report.html"
    part = path.with_name(path.name + ".part")
    part.write_text(report_html(run), encoding="utf-8")
    os.replace(part, path)
    return path


def report_html(run: RunView) -> str:
    """The page as text; every name in it is escaped, nothing in it needs a network."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    env = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    cell_command = f"sysid-bench cell {shlex.quote(_short_path(run.folder))} "
    return env.get_template("report.html.jinja").render(
        name=run.suite.get("name") or run.folder.name,
        title=run.suite.get("title") or run.suite.get("name") or run.folder.name,
        command=run.command,
        cell_command=cell_command,
        headline=headline(run.cells),
        crosschecks=crosscheck_rows(run.cells),
        tolerance=_tolerance(run.suite),
        tables=(*run.tables, *(ranking.order for ranking in run.rankings)),
        listings=run.listings,
        pictures=[(title, Markup(svg)) for title, svg in run.pictures],
        pairs=[table for ranking in run.rankings for table in ranking.tables[1:]],
        figures=[
            *((ranking.title, PROFILE, Markup(profile_svg(ranking))) for ranking in run.rankings),
            *((t.title, t.caption, Markup(figure_svg(t))) for t in _pictured(run)),
        ],
        assumptions=assumptions(run.suite, run.cells),
        failures=failures(run.cells),
        joints=joint_errors(run.cells, run.joints),
        provenance=environment_lines(run.env),
        data=Markup(_script_safe(cells_as_data(run.cells, run.recordings, run.metrics))),
    )


def _pictured(run: RunView) -> list[Table]:
    """The first table that fits a figure, and the map of gaps."""
    fitting = [
        table
        for table in run.tables
        if 0 < len(table.rows) <= _MOST_ROWS_OF_A_FIGURE and table.has_figure
    ]
    gaps = {"rows": ["robot"], "columns": ["payload"], "cells": {"metric": "gap", "stat": "max"}}
    chosen = fitting[:1]
    if {"robot", "payload", "gap"} <= set(run.cells.columns) and run.cells["gap"].notna().any():
        # The cross-check belongs to the robot: a failed estimator takes nothing from it.
        measured = run.cells[run.cells["gap"].notna()].assign(status="ok")
        table = make_table(measured, {"name": "gap", **gaps})
        chosen += [table] if len(table.rows) <= _MOST_ROWS_OF_A_FIGURE else []
    return chosen


def _tolerance(suite: Mapping[str, Any]) -> float | None:
    tolerance = (suite.get("crosscheck") or {}).get("tolerance")
    return None if tolerance is None else float(tolerance)


def _short_path(folder: Path) -> str:
    """Relative where the run lies below the working folder: a report may be handed on."""
    absolute, here = folder.resolve(), Path.cwd().resolve()
    return absolute.relative_to(here).as_posix() if absolute.is_relative_to(here) else str(folder)


def _script_safe(data: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
