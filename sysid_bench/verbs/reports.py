"""From rows to paper and screen."""

import shlex
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.verbs.folders import open_run
from sysid_bench.verbs.paper_output import draw_papers, paper_outputs, text_of

if TYPE_CHECKING:
    from sysid_bench.harness.store import RunFolder
    from sysid_bench.reporting.latex import Origin
    from sysid_bench.reporting.rankings import Ranking
    from sysid_bench.reporting.tables import Table

DEFAULT_TABLE: Mapping[str, Any] = {
    "name": "main",
    "title": "Held-out torque error",
    "rows": ["robot", "payload"],
    "columns": ["task", "noise", "estimator"],
    "cells": {"metric": "torque_error", "stat": "median", "interval": "iqr"},
    "best": "min-bold",
}
FORMATS = ("md", "csv", "latex")


def report(folder: str | Path) -> Path:
    """Writes tables/, figures/ and report.html of a run from its rows; the report's path."""
    from sysid_bench.reporting.figures import figure, svg_element
    from sysid_bench.reporting.html import RunView, write_report
    from sysid_bench.reporting.latex import to_macros
    from sysid_bench.reporting.profiles import profile

    run_folder = open_run(folder)
    frames = run_folder.frames()
    if len(frames.cells) == 0:
        raise UsageError(f"{str(folder)!r} has no rows yet; run it first.")
    own, ranked, origin = tuple(_tables(run_folder)), _rankings(run_folder), _origin(run_folder)
    orders = tuple(ranking.order for ranking in ranked)
    for place in ("tables", "figures"):
        (run_folder.path / place).mkdir(exist_ok=True)
    for table in (*own, *(made for ranking in ranked for made in ranking.tables)):
        for form, suffix in zip(FORMATS, ("md", "csv", "tex"), strict=True):
            _put(run_folder.path / "tables" / f"{table.name}.{suffix}", _text(table, form, origin))
    for suffix in ("pdf", "svg"):
        for table in own:
            if table.is_drawable:
                figure(table, run_folder.path / "figures" / f"{table.name}.{suffix}")
        for ranking in ranked:
            profile(ranking, run_folder.path / "figures" / f"{ranking.name}.{suffix}")
    listings = paper_outputs(run_folder)
    for listing in listings:
        for form, suffix in zip(FORMATS, ("md", "csv", "tex"), strict=True):
            text = text_of(listing, form, origin)
            _put(run_folder.path / "tables" / f"{listing.name}.{suffix}", text)
    drawn = draw_papers(run_folder, run_folder.path / "figures")
    _put(run_folder.path / "tables" / "numbers.tex", to_macros((*own, *orders), origin))
    return write_report(
        RunView(
            folder=run_folder.path,
            suite=tomllib.loads((run_folder.path / "run.toml").read_text(encoding="utf-8")),
            env=run_folder.env,
            cells=frames.cells,
            joints=frames.joints,
            tables=own,
            rankings=ranked,
            metrics=run_folder.suite.metrics,
            recordings=recordings(run_folder),
            command=origin.command,
            listings=listings,
            pictures=tuple((title, svg_element(path.read_bytes())) for title, path in drawn),
        )
    )


def table(folder: str | Path, name: str, form: str = "md") -> str:
    """One table of a run as Markdown, CSV or LaTeX."""
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    run_folder = open_run(folder)
    tables = {made.name: made for made in _tables(run_folder)}
    if name not in tables and name in [entry.name for entry in run_folder.suite.paper]:
        listings = {made.name: made for made in paper_outputs(run_folder, name)}
        if name not in listings:
            raise UsageError(f"{name!r} has no sound cell yet, or is a figure: see figures/.")
        return text_of(listings[name], form, _origin(run_folder))
    if name not in tables:  # rankings are drawn again and again: made where one is asked for
        tables |= {made.name: made for made in _orders(run_folder)}
    if name not in tables:
        raise unknown_name("table", name, tables)
    return _text(tables[name], form, _origin(run_folder))


def printed_tables(folder: str | Path) -> list[str]:
    """Every table of a run as Markdown, for the terminal."""
    run = open_run(folder)
    orders = (ranking.order for ranking in _rankings(run))
    return [_text(made, "md", _origin(run)) for made in (*_tables(run), *orders)]


def recordings(run_folder: "RunFolder") -> dict[str, str]:
    """Cells that have a recording, with its path relative to the run."""
    found = sorted((run_folder.path / "artifacts").glob("*/*.rrd"))
    return {file.parent.name: str(file.relative_to(run_folder.path)) for file in found}


def _tables(run_folder: "RunFolder") -> Iterator["Table"]:
    from sysid_bench.reporting.make_table import make_table
    from sysid_bench.vocabulary import JOINT, PARAMETER, STD_FROM

    frames = run_folder.frames()
    cells = frames.cells
    suite = run_folder.suite
    specs = [entry.model_dump(exclude_none=True) for entry in suite.table] or [dict(DEFAULT_TABLE)]
    for spec in specs:
        try:
            asked = (*spec["rows"], *spec["columns"])
            lines = frames.by_parameter if PARAMETER in asked else cells
            lines = frames.by_std_from if STD_FROM in asked else lines
            lines = frames.by_joint if JOINT in asked else lines
            yield make_table(lines, spec, _choose, frames.parameters, suite.metrics)
        except UsageError:
            if len(cells) == len(run_folder.plan.cells):
                raise  # with some cells not run, a table may have nothing to show yet


def _rankings(run_folder: "RunFolder") -> "tuple[Ranking, ...]":
    from sysid_bench.reporting.rankings import rankings

    cells = run_folder.frames().cells
    found: list[Ranking] = []
    for entry in run_folder.suite.ranking:
        try:
            spec = entry.model_dump(exclude_none=True)
            found += rankings(cells, spec, _choose, run_folder.suite.metrics)
        except UsageError:
            if len(cells) == len(run_folder.plan.cells):
                raise
    return tuple(found)


def _orders(run_folder: "RunFolder") -> "Iterator[Table]":
    for ranking in _rankings(run_folder):
        yield from ranking.tables


def _choose(expression: str, cell: Mapping[str, Any]) -> bool:
    from sysid_bench.harness.suite.expression import Expression

    return Expression.parse(expression).matches(cell)


def _text(table: "Table", form: str, origin: "Origin") -> str:
    from sysid_bench.reporting.delimited import to_csv
    from sysid_bench.reporting.latex import to_latex
    from sysid_bench.reporting.markdown import to_markdown

    if form == "md":
        return to_markdown(table)
    return to_csv(table) if form == "csv" else to_latex(table, origin)


def _put(path: Path, text: str) -> None:
    """The file, whole or not at all."""
    beside = path.with_name(f"{path.name}.part")
    beside.write_text(text, encoding="utf-8")
    beside.replace(path)


def _origin(run_folder: "RunFolder") -> "Origin":
    from sysid_bench.canonical_json import digest
    from sysid_bench.reporting.latex import Origin

    cells = sorted(cell.id for cell in run_folder.plan.cells)
    suite = run_folder.suite
    typed = suite.origin.command if suite.origin else None
    command = typed or f"sysid-bench run {shlex.quote(suite.name)}"
    return Origin(run_folder.path.name, digest(cells)[:12], command)
