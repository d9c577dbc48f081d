"""Offline pages of one file: report of a run, findings of a diagnosis, comparison of two runs.

All are Jinja templates of this folder; every name in them is escaped.
"""

import json
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from markupsafe import Markup

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import figure, page_svg
from sysid_bench.reporting.ranking import Ranking
from sysid_bench.reporting.ranking_figures import cost_by_method, cost_figure, profile
from sysid_bench.reporting.ranking_tables import ranking_tables
from sysid_bench.reporting.report_data import (
    CELLS,
    cells_to_json,
    crosscheck_rows,
    data_text,
    environment_lines,
    failed_cells,
    first_cells,
    joint_blocks,
    run_summary,
    torque_data,
)
from sysid_bench.reporting.sections import experiment_lines, joint_errors, plant_tables
from sysid_bench.reporting.signal_figures import StoredTorque, torque_figure
from sysid_bench.reporting.tables import Table
from sysid_bench.reporting.text_table import TextTable
from sysid_bench.types import Array, Metric

if TYPE_CHECKING:
    import pandas as pd
    from jinja2 import Template


# Taller figures are not readable; the tables of the page hold the same numbers.
_MOST_ROWS_OF_A_FIGURE: Final = 45
_ROWS_AT_ONCE: Final = 50  # PAGE of report.js: rows that are drawn before all cells are read
PROFILE: Final = (
    "Profile: the share of a method's cases in which its error is within so many times that of the "
    "reference; a failure is within none; the first methods of the ranking in colour."
)

COST: Final = (
    "A failure counts as the answer of the reference; the line joins the methods that no other is "
    "both quicker and better than."
)


@dataclass(frozen=True, eq=False)
class RunView:
    """Data of a run for its report. `recordings` maps a cell's id to a path relative to the
    folder; `command` is what made the run; `joints` has a column `id` (or `cell`) and the joint
    fields of Score; `suite` and `env` are the run's TOML and environment as read; `torques` maps a
    cell's id to what it stored along a test log."""

    folder: Path
    suite: Mapping[str, Any]
    env: Mapping[str, Any]
    cells: "pd.DataFrame"
    joints: "pd.DataFrame"
    tables: tuple[Table, ...]
    recordings: Mapping[str, str]
    command: str
    listings: tuple[TextTable, ...] = ()
    notes: tuple[str, ...] = ()  # on rows of other code, and on recordings that are absent
    pictures: tuple[tuple[str, str], ...] = ()  # title and <svg> of figures drawn elsewhere
    rankings: tuple[Ranking, ...] = ()
    metrics: Mapping[str, Metric] = field(default_factory=lambda: METRICS)
    torques: Mapping[str, StoredTorque] = field(default_factory=dict)


def write_report(run: RunView) -> Path:
    """Write `report.html` into the run's folder, whole or not at all; return its path."""
    path = run.folder / "report.html"
    part = path.with_name(path.name + ".part")
    part.write_text(report_html(run), encoding="utf-8")
    os.replace(part, path)
    return path


def report_html(run: RunView) -> str:
    """The page as text; every name in it is escaped, nothing in it needs a network."""
    orders = list(map(ranking_tables, run.rankings))
    folder, chunks = shlex.quote(_short_path(run.folder)), joint_blocks(run.cells, run.joints)
    cells = cells_to_json(run.cells, run.recordings, run.metrics)
    data = {**cells, "chunk": CELLS, "hasJoints": len(chunks) > 0}
    name = run.suite.get("name") or run.folder.name
    tolerance = (run.suite.get("crosscheck") or {}).get("tolerance")
    # On a cell: to run it again, to print its whole row, to open its recording.
    commands = {word: f"sysid-bench {word} {folder} " for word in ("run", "cell", "view")}
    commands["run"] += "--select 'id == \"ID\"' --rerun all"
    return _render(
        "report",
        name=name,
        title=run.suite.get("title") or name,
        command=run.command,
        cell_command=f"sysid-bench cell {folder} ",
        compare_command=f"sysid-bench compare {folder} OTHER --html compare.html",
        pages=sorted(page.name for page in run.folder.glob("compare*.html")),
        notes=run.notes,
        summary=run_summary(run.cells),
        crosschecks=crosscheck_rows(run.cells),
        tolerance=None if tolerance is None else float(tolerance),
        tables=run.tables,
        rankings=[order[0] for order in orders],
        levels=tuple(plant_tables(run.cells)),
        listings=run.listings,
        pictures=[(title, Markup(page_svg(svg))) for title, svg in run.pictures],
        pairs=list(chain.from_iterable(order[1:] for order in orders)),
        figures=[(title, caption, Markup(page_svg(svg))) for title, caption, svg in _figures(run)],
        assumptions=experiment_lines(run.suite, run.cells),
        failures=failed_cells(run.cells),
        joints=joint_errors(run.cells, run.joints),
        provenance=environment_lines(run.env),
        first=Markup(_script_safe(first_cells(data, _ROWS_AT_ONCE))),
        data=data_text(data),
        chunks=chunks,
        curves=[(cell, torque_data(sample)) for cell, sample in run.torques.items()],
        commands=Markup(_script_safe(commands)),
    )


def _render(template: str, /, **values: Any) -> str:
    """A page of this folder; every value is escaped."""
    return page_layout(f"{template}.html.jinja", Path(__file__).parent).render(values)


@cache
def page_layout(name: str, *folders: Path) -> "Template":
    """A template of these folders; a value that it names and nobody gives is an error, and every
    value is escaped."""
    import jinja2

    env = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return env.get_template(name)


def _figures(run: RunView) -> Iterator[tuple[str, str, str]]:
    """Title, caption and <svg> of every ranking, the first table that fits, the map of gaps."""
    for ranking in run.rankings:
        yield ranking.title, PROFILE, profile.svg(ranking)
        if cost_by_method(ranking, run.cells):
            title = f"{ranking.title}: error and CPU time"
            yield title, COST, cost_figure.svg(ranking, run.cells)

    def fits(table: Table) -> bool:
        return table.has_figure and 0 < len(table.rows) <= _MOST_ROWS_OF_A_FIGURE

    for table in filter(fits, (*islice(filter(fits, run.tables), 1), *_gap_map(run.cells))):
        yield table.title, table.description, figure.svg(table)


def _gap_map(cells: "pd.DataFrame") -> Iterator[Table]:
    """Largest gap by robot and payload; nothing where no cell was cross-checked."""
    if not {"robot", "payload", "gap"} <= set(cells.columns):
        return
    measured = cells[cells["gap"].notna()]
    if len(measured) > 0:
        gaps = {
            "rows": ["robot"],
            "columns": ["payload"],
            "cells": {"metric": "gap", "stat": "max"},
        }
        # The cross-check belongs to the robot: a failed estimator takes nothing from it.
        yield build_table(measured.assign(status="ok"), {"name": "gap", **gaps})


def _short_path(folder: Path) -> str:
    """Relative where the run lies below the working folder: a report may be handed on."""
    # A run elsewhere needs its whole path for the command to work.
    absolute, here = folder.resolve(), Path.cwd().resolve()
    return absolute.relative_to(here).as_posix() if absolute.is_relative_to(here) else str(folder)


def _script_safe(data: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Measured torque of a recording and that of the fit near the model, (N, n) at t (N,)."""

    title: str
    t: Array
    rows: Sequence[str]
    measured: Array
    fitted: Array
    units: Sequence[str]


def write_findings_html(
    path: Path, title: str, findings: Sequence[Mapping[str, Any]], torques: Sequence[TorqueFit]
) -> Path:
    """Write the page into an .html file, complete in itself."""
    samples = [
        StoredTorque(one.title, one.t, one.measured, one.fitted, tuple(one.rows), tuple(one.units))
        for one in torques
    ]
    drawn = [(sample, Markup(torque_figure.svg(sample))) for sample in samples]
    page = _render("findings", title=title, findings=findings, torques=drawn)
    path.write_text(page + "\n", encoding="utf-8")
    return path


MOST_ROWS: Final = 2000
"""Rows of a table in the page; a page of 5,000 cells stays below a megabyte."""


def write_compare_page(
    file: Path, title: str, listings: Sequence[TextTable], notes: Sequence[str]
) -> None:
    """Write the tables and notes into an .html file; needs no network."""
    sections = []
    for listing in listings:
        rows = listing.rows[:MOST_ROWS]
        # Numbers are aligned right; a column that is not shown has no class.
        columns = zip(*rows, strict=True) if rows else ((),) * len(listing.head)
        classes = [Markup(" class=n" if _has_numbers(column) else "") for column in columns]
        sections.append((listing, rows, classes))
    page = _render("compare", title=title, notes=notes, sections=sections)
    file.write_text(page + "\n", encoding="utf-8")


def _has_numbers(texts: Sequence[str]) -> bool:
    """True for a column of numbers; a dash stands for one that is missing."""
    try:
        return len([float(text) for text in texts if text != "-"]) > 0
    except ValueError:
        return False
