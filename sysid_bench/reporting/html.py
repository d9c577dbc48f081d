"""Pages."""

import json
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape
from itertools import chain, islice, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.build_table import build_table
from sysid_bench.reporting.figures import figure_svg, page_svg
from sysid_bench.reporting.ranking import Ranking
from sysid_bench.reporting.ranking_figures import cost_svg, profile_svg
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
from sysid_bench.reporting.signal_figures import StoredTorque, torque_svg
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
    from markupsafe import Markup

    orders = list(map(ranking_tables, run.rankings))
    folder, chunks = shlex.quote(_short_path(run.folder)), joint_blocks(run.cells, run.joints)
    name, data = run.suite.get("name") or run.folder.name, _data(run, len(chunks))
    return _template().render(
        name=name,
        title=run.suite.get("title") or name,
        command=run.command,
        cell_command=f"sysid-bench cell {folder} ",
        compare_command=f"sysid-bench compare {folder} OTHER --html compare.html",
        pages=sorted(page.name for page in run.folder.glob("compare*.html")),
        notes=run.notes,
        summary=run_summary(run.cells),
        crosschecks=crosscheck_rows(run.cells),
        tolerance=_tolerance(run.suite),
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
        commands=Markup(_script_safe(_commands(folder))),
    )


def _data(run: RunView, chunks: int) -> dict[str, Any]:
    """All cells, and where their joints are."""
    cells = cells_to_json(run.cells, run.recordings, run.metrics)
    return {**cells, "chunk": CELLS, "hasJoints": chunks > 0}


def _commands(folder: str) -> dict[str, str]:
    """Commands on a cell: to run it again, to print its whole row, to open its recording."""
    return {
        "run": f"sysid-bench run {folder} --select 'id == \"ID\"' --rerun all",
        "cell": f"sysid-bench cell {folder} ",
        "view": f"sysid-bench view {folder} ",
    }


def _template() -> "Template":
    """The page's template."""
    return page_layout("report.html.jinja", Path(__file__).parent)


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
        yield ranking.title, PROFILE, profile_svg(ranking)
        cost = cost_svg(ranking, run.cells)
        if cost:
            yield f"{ranking.title}: error and CPU time", COST, cost
    first = islice(filter(_fits_a_figure, run.tables), 1)
    for table in filter(_fits_a_figure, (*first, *_gap_map(run.cells))):
        yield table.title, table.description, figure_svg(table)


def _fits_a_figure(table: Table) -> bool:
    return table.has_figure and 0 < len(table.rows) <= _MOST_ROWS_OF_A_FIGURE


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


def _tolerance(suite: Mapping[str, Any]) -> float | None:
    tolerance = (suite.get("crosscheck") or {}).get("tolerance")
    return None if tolerance is None else float(tolerance)


def _short_path(folder: Path) -> str:
    """Relative where the run lies below the working folder: a report may be handed on."""
    # A run elsewhere needs its whole path for the command to work.
    absolute, here = folder.resolve(), Path.cwd().resolve()
    return absolute.relative_to(here).as_posix() if absolute.is_relative_to(here) else str(folder)


def _script_safe(data: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


STYLE: Final = (
    "body{font:15px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse;width:100%}td,th{border-bottom:1px solid #ccc;padding:.4rem;"
    "text-align:left;vertical-align:top}.error{color:#b00020;font-weight:bold}"
    ".warning{color:#a15c00;font-weight:bold}.note{color:#555}code{background:#f3f3f3}"
    "svg{max-width:100%;height:auto}"
)
HEADINGS: Final = ("", "finding", "explains", "what to do", "blind for")


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
    path: Path,
    title: str,
    findings: Sequence[Mapping[str, Any]],
    torques: Sequence[TorqueFit],
) -> Path:
    """Write the page into an .html file, complete in itself."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        f"<style>{STYLE}</style><h1>{escape(title)}</h1>",
        _table(findings),
        *(_figure(torque) for torque in torques),
        "</html>\n",
    ]
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _table(findings: Sequence[Mapping[str, Any]]) -> str:
    if not findings:
        return "<p>No finding.</p>"
    head = "".join(f"<th>{heading}</th>" for heading in HEADINGS)
    return f"<table><tr>{head}</tr>{''.join(map(_row, findings))}</table>"


def _row(finding: Mapping[str, Any]) -> str:
    share = finding["explains"]
    cells = [
        f"<span class={finding['severity']}>{finding['severity']}</span>",
        f"<b>{escape(finding['name'])}</b>: {escape(finding['message'])} "
        f"<small>({escape(finding['log'])})</small>",
        "" if share is None else f"{100 * share:.0f} %",
        f"<code>{escape(finding['edit'])}</code>" if finding["edit"] else "",
        escape(finding["blind"]),
    ]
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _figure(torque: TorqueFit) -> str:
    rows, units = tuple(torque.rows), tuple(torque.units)
    sample = StoredTorque(torque.title, torque.t, torque.measured, torque.fitted, rows, units)
    drawn = torque_svg(sample)
    caption = (
        f"{torque.title}: filtered torque, and the nearest that a robot much like the model gives "
        "with friction, armature and offset."
    )
    return f"<h2>{escape(torque.title)}</h2><p>{escape(caption)}</p>{drawn}"


MOST_ROWS: Final = 2000
"""Rows of a table in the page; a page of 5,000 cells stays below a megabyte."""
_SCRIPT: Final = (
    "document.querySelectorAll('input').forEach(i=>i.oninput=()=>{"
    "const w=i.value.toLowerCase().split(/\\s+/);"
    "i.parentElement.parentElement.querySelectorAll('tbody tr').forEach(r=>{"
    "const t=r.textContent.toLowerCase();r.hidden=!w.every(x=>t.includes(x))})})"
)


def write_compare_page(
    file: Path, title: str, listings: Sequence[TextTable], notes: Sequence[str]
) -> None:
    """Write the tables and notes into an .html file; needs no network."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<style>{_style()}</style><h1>{escape(title)}</h1><main>",
        *(f"<pre>{escape(note)}</pre>" for note in notes),
        *map(_section, listings),
        f"</main><script>{_SCRIPT}</script></html>\n",
    ]
    file.write_text("\n".join(parts), encoding="utf-8")


def _style() -> str:
    """The style of report.html."""
    return Path(__file__).with_name("report.css").read_text(encoding="utf-8")


def _section(listing: TextTable) -> str:
    shown = listing.rows[:MOST_ROWS]
    classes = list(map(_class, zip(*shown, strict=True))) or [""] * len(listing.head)
    head = "".join(map(_cell, repeat("th scope=col"), listing.head, classes))
    rows = "".join(f"<tr>{''.join(map(_cell, repeat('td'), row, classes))}</tr>" for row in shown)
    more = len(listing.rows) - MOST_ROWS
    notes = [*listing.notes, *([f"{more} more rows are in --format json."] if more > 0 else [])]
    search = "<p><label>Filter <input type=search></label></p>" if len(listing.rows) > 8 else ""
    title = escape(listing.title)
    return (
        f"<section><h2>{title}</h2>{search}"
        f'<div class=scroll tabindex=0 role=region aria-label="{title}">'
        f"<table class=listing><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        + "".join(f"<p class=soft>{escape(note)}</p>" for note in notes)
        + "</section>"
    )


def _class(texts: Sequence[str]) -> str:
    """Attribute of a column: numbers are aligned right."""
    numbers = [text for text in texts if text != "-"]
    return " class=n" if numbers and all(map(_is_number, numbers)) else ""


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _cell(tag: str, text: str, attribute: str) -> str:
    return f"<{tag}{attribute}>{escape(text)}</{tag.split()[0]}>"
