"""The commands `report` and `table`: from the rows of a run to paper and screen."""

import shlex
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.canonical_json import digest
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.reporting.csv_table import to_csv
from sysid_bench.reporting.figures import figure, svg_element
from sysid_bench.reporting.html import RunView, write_report
from sysid_bench.reporting.latex import Origin, to_latex
from sysid_bench.reporting.latex_macros import to_macros
from sysid_bench.reporting.listing import Listing
from sysid_bench.reporting.make_table import make_table
from sysid_bench.reporting.markdown import to_markdown
from sysid_bench.reporting.performance_profile import profile
from sysid_bench.reporting.rankings import Ranking, rankings
from sysid_bench.reporting.tables import Table
from sysid_bench.verbs.folders import open_run
from sysid_bench.verbs.paper_output import draw_paper_figures, paper_tables, text_of
from sysid_bench.vocabulary import JOINT, PARAMETER, STD_FROM

if TYPE_CHECKING:
    from sysid_bench.harness.store import RunFolder

DEFAULT_TABLE: Final[Mapping[str, Any]] = {
    "name": "main",
    "title": "Held-out torque error",
    "rows": ["robot", "payload"],
    "columns": ["task", "noise", "estimator"],
    "cells": {"metric": "torque_error", "stat": "median", "interval": "iqr"},
    "best": "min-bold",
}
"""The table of a suite that names none."""

FORMATS: Final = ("md", "csv", "latex")
_SUFFIXES: Final = {"md": "md", "csv": "csv", "latex": "tex"}


def report(folder: str | Path) -> Path:
    """Write tables/, figures/ and report.html of a run from its folder alone; return its path.

    Raises UsageError for a folder without rows.
    """
    run_folder = open_run(folder)
    frames = run_folder.frames()
    if len(frames.cells) == 0:
        raise UsageError(f"{str(folder)!r} has no rows yet; run it first.")
    tables, ranked = tuple(_tables(run_folder)), _rankings(run_folder)
    listings, origin = paper_tables(run_folder), _origin(run_folder)
    for name in ("tables", "figures"):
        (run_folder.path / name).mkdir(exist_ok=True)
    _write_tables(run_folder.path / "tables", tables, ranked, listings, origin)
    _draw(run_folder.path / "figures", tables, ranked)
    drawn = draw_paper_figures(run_folder, run_folder.path / "figures")
    return write_report(
        RunView(
            folder=run_folder.path,
            suite=tomllib.loads((run_folder.path / "run.toml").read_text(encoding="utf-8")),
            env=run_folder.env,
            cells=frames.cells,
            joints=frames.joints,
            tables=tables,
            rankings=ranked,
            metrics=run_folder.suite.metrics,
            recordings=recordings(run_folder),
            command=origin.command,
            listings=listings,
            pictures=tuple((title, svg_element(path.read_bytes())) for title, path in drawn),
        )
    )


def table(folder: str | Path, name: str, form: str = "md") -> str:
    """One table of a run as Markdown ("md"), CSV or LaTeX; UsageError for an unknown name."""
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    run_folder = open_run(folder)
    tables = {made.name: made for made in _tables(run_folder)}
    if name not in tables and name in [entry.name for entry in run_folder.suite.paper]:
        listings = {made.name: made for made in paper_tables(run_folder, name)}
        if name not in listings:
            raise UsageError(f"{name!r} has no ok cell yet, or is a figure: see figures/.")
        return text_of(listings[name], form, _origin(run_folder))
    if name not in tables:  # rankings resample thousands of times: made only where one is named
        tables |= {made.name: made for ranking in _rankings(run_folder) for made in ranking.tables}
    if name not in tables:
        raise unknown_name("table", name, tables)
    return _text(tables[name], form, _origin(run_folder))


def printed_tables(folder: str | Path) -> list[str]:
    """Every table of a run as Markdown, for the terminal."""
    run = open_run(folder)
    orders = (ranking.summary_table for ranking in _rankings(run))
    return [_text(made, "md", _origin(run)) for made in (*_tables(run), *orders)]


def recordings(run_folder: "RunFolder") -> dict[str, str]:
    """Path of each cell's recording, relative to the run, by cell id."""
    found = sorted((run_folder.path / "artifacts").glob("*/*.rrd"))
    return {file.parent.name: str(file.relative_to(run_folder.path)) for file in found}


def _write_tables(
    folder: Path,
    tables: tuple[Table, ...],
    ranked: tuple[Ranking, ...],
    listings: tuple[Listing, ...],
    origin: Origin,
) -> None:
    """Every table as Markdown, CSV and LaTeX, and all numbers as LaTeX macros."""
    for form, suffix in _SUFFIXES.items():
        for made in (*tables, *(pair for ranking in ranked for pair in ranking.tables)):
            _put(folder / f"{made.name}.{suffix}", _text(made, form, origin))
        for listing in listings:
            _put(folder / f"{listing.name}.{suffix}", text_of(listing, form, origin))
    orders = tuple(ranking.summary_table for ranking in ranked)
    _put(folder / "numbers.tex", to_macros((*tables, *orders), origin))


def _draw(folder: Path, tables: tuple[Table, ...], ranked: tuple[Ranking, ...]) -> None:
    for suffix in ("pdf", "svg"):
        for made in tables:
            if made.has_figure:
                figure(made, folder / f"{made.name}.{suffix}")
        for ranking in ranked:
            profile(ranking, folder / f"{ranking.name}.{suffix}")


def _tables(run_folder: "RunFolder") -> Iterator[Table]:
    frames, suite = run_folder.frames(), run_folder.suite
    specs = [entry.model_dump(exclude_none=True) for entry in suite.table] or [dict(DEFAULT_TABLE)]
    for spec in specs:
        axes = (*spec["rows"], *spec["columns"])
        lines = frames.by_parameter if PARAMETER in axes else frames.cells
        lines = frames.by_std_from if STD_FROM in axes else lines
        lines = frames.by_joint if JOINT in axes else lines
        try:
            yield make_table(lines, spec, _choose, frames.parameters, suite.metrics)
        except UsageError:
            if _is_complete(run_folder):
                raise


def _rankings(run_folder: "RunFolder") -> tuple[Ranking, ...]:
    cells, suite = run_folder.frames().cells, run_folder.suite
    found: list[Ranking] = []
    for entry in suite.ranking:
        spec = entry.model_dump(exclude_none=True)
        try:
            found += rankings(cells, spec, _choose, suite.metrics)
        except UsageError:
            if _is_complete(run_folder):
                raise
    return tuple(found)


def _is_complete(run_folder: "RunFolder") -> bool:
    """True where every cell has a row: before that, a table may have nothing to show yet."""
    return len(run_folder.frames().cells) == len(run_folder.plan.cells)


def _choose(expression: str, cell: Mapping[str, Any]) -> bool:
    return Expression.parse(expression).matches(cell)


def _text(table: Table, form: str, origin: Origin) -> str:
    if form == "md":
        return to_markdown(table)
    return to_csv(table) if form == "csv" else to_latex(table, origin)


def _put(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f"{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def _origin(run_folder: "RunFolder") -> Origin:
    cells = sorted(cell.id for cell in run_folder.plan.cells)
    suite = run_folder.suite
    typed = suite.origin.command if suite.origin else None
    command = typed or f"sysid-bench run {shlex.quote(suite.name)}"
    return Origin(run_folder.path.name, digest(cells)[:12], command)
