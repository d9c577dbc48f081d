"""Tables, rankings, figures and page of a run, made from its folder alone."""

import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.commands.claims import claims_of
from sysid_bench.commands.paper import paper_tables, text_of, torque_samples, write_paper_figures
from sysid_bench.commands.record import recording_notes
from sysid_bench.commands.report import FORMATS
from sysid_bench.commands.run_folder import (
    condition,
    no_rows,
    open_run,
    row_notes,
    row_selection,
    run_origin,
    write_whole,
)
from sysid_bench.errors import UsageError, reason_of, unknown_name
from sysid_bench.evaluation.intervals import at_level
from sysid_bench.evaluation.repeat_statistic import PARAMETER_COLUMNS, SETTING
from sysid_bench.harness.frames import Frames
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.build_table import build_table, table_fields
from sysid_bench.reporting.figures import figure, svg_element
from sysid_bench.reporting.html import RunView, write_report
from sysid_bench.reporting.latex import Origin, macro_text, suite_macro_text, to_latex
from sysid_bench.reporting.ranking import (
    Ranking,
    correct_together,
    entry_with_cells,
    rank_cells,
)
from sysid_bench.reporting.ranking_figures import profile
from sysid_bench.reporting.ranking_tables import ranking_tables, verdict_table
from sysid_bench.reporting.report_data import JOINT_SCORES
from sysid_bench.reporting.sections import JOINT_COLUMNS
from sysid_bench.reporting.selection import SWEEPABLE, metric_names
from sysid_bench.reporting.tables import Table
from sysid_bench.reporting.text_table import TextTable
from sysid_bench.reporting.writers import to_csv, to_json, to_markdown
from sysid_bench.words import JOINT, OF_REPEATS, PARAMETER, STD_FROM

if TYPE_CHECKING:
    import pandas as pd

_DEFAULT_TABLE: Final[Mapping[str, Any]] = {
    "name": "main",
    "title": "Held-out torque error",
    "rows": ["robot", "payload"],
    "columns": ["task", "noise", "estimator"],
    "cells": {"metric": "torque_error", "stat": "median", "interval": "iqr"},
    "best": "min-bold",
}
"""The table of a suite that names none."""
_FRAMES: Final = {JOINT: "by_joint", STD_FROM: "by_std_from", PARAMETER: "by_parameter"}
"""Data with a row for each value of an axis, made when it is read."""


def write_report_of(folder: str | Path) -> Path:
    """Write tables/, figures/ and report.html of a run; return the path of the page."""
    run, frames = _opened(folder)
    with at_level(run.suite.confidence):
        tables, ranked = tuple(_tables(run, frames)), _rankings(run, frames)
        tested = claims_of(run)
        listings = (*paper_tables(run), *([tested.listing] if tested else []))
        note = row_notes(run)
        origin = replace(run_origin(run, len(frames.cells)), note=note)
        figures = run.path / "figures"
        for place in (run.path / "tables", figures):
            place.mkdir(exist_ok=True)
        _write_tables(run, frames, tables, ranked, listings, origin)
        for suffix in ("pdf", "svg"):
            for made in filter(lambda one: one.has_figure, tables):
                figure.write(figures / f"{made.name}.{suffix}", made)
            for ranking in ranked:
                profile.write(figures / f"{ranking.name}.{suffix}", ranking)
        drawn = write_paper_figures(run, figures)
        recordings = sorted((run.path / "artifacts").glob("*/*.rrd"))
        return write_report(
            RunView(
                folder=run.path,
                suite=parse_toml(read_text(run.path / "run.toml")),
                env=run.environment,
                cells=frames.cells,
                joints=frames.read("joints", {*JOINT_COLUMNS, *JOINT_SCORES}),
                tables=tables,
                rankings=ranked,
                metrics=run.suite.metrics,
                recordings={
                    file.parent.name: str(file.relative_to(run.path)) for file in recordings
                },
                command=origin.command,
                listings=listings,
                notes=(*filter(None, [note]), *recording_notes(run)),
                torques=torque_samples(run),
                pictures=tuple((title, svg_element(path.read_bytes())) for title, path in drawn),
            )
        )


def table_text(folder: str | Path, name: str, form: str) -> str:
    """Return one table of a run in one of FORMATS."""
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    run, frames = _opened(folder)
    with at_level(run.suite.confidence):
        origin = run_origin(run, len(frames.cells))
        if form == "latex":
            origin = replace(origin, note=row_notes(run))
        tables = _by_name(_tables(run, frames, name))
        if name not in tables and name in [entry.name for entry in run.suite.paper]:
            for listing in paper_tables(run, name):
                return text_of(listing, form, origin)
            raise UsageError(f"{name!r} has no ok cell yet, or is a figure: see figures/.")
        if name not in tables:
            # Rankings resample thousands of times: made only where one is named.
            tables = _by_name(chain.from_iterable(map(ranking_tables, _rankings(run, frames))))
        if name not in tables:
            raise unknown_name("table", name, tables | _by_name(_tables(run, frames)))
        return _text(tables[name], form, origin)


def table_of(folder: str | Path, name: str) -> Table | None:
    """Return one table of a run, None where none has the name; raise UsageError for a folder
    without rows."""
    run, frames = _opened(folder)
    with at_level(run.suite.confidence):
        return _by_name(_tables(run, frames, name)).get(name)


def result_of(
    folder: str | Path,
) -> tuple[RunFolder, Frames, tuple[Table, ...], tuple[Ranking, ...]]:
    """Return a run, its data, its tables with a figure and its rankings; raise UsageError for a
    folder without rows."""
    run, frames = _opened(folder)
    with at_level(run.suite.confidence):
        names = [spec["name"] for spec in _specs(run) if not spec.get("metrics")]
        made = (one for name in names for one in _tables(run, frames, name))
        return run, frames, tuple(one for one in made if one.has_figure), _rankings(run, frames)


def summary_tables(folder: str | Path) -> list[str]:
    """Return every table of a run as Markdown, for the terminal."""
    run = open_run(folder)
    frames = run.frames()
    with at_level(run.suite.confidence):
        orders = map(verdict_table, _rankings(run, frames))
        return [to_markdown(made) for made in (*_tables(run, frames), *orders)]


def _opened(folder: str | Path) -> tuple[RunFolder, Frames]:
    """A run with rows and its data."""
    run = open_run(folder)
    frames = run.frames()
    if len(frames.cells) == 0:
        raise no_rows(run)
    return run, frames


def _by_name(tables: Iterable[Table]) -> dict[str, Table]:
    return {made.name: made for made in tables}


def _tables(run: RunFolder, frames: Frames, name: str | None = None) -> Iterator[Table]:
    """The tables of a run, or the one with a name."""
    for spec in _specs(run):
        if name in (None, spec["name"]):
            with _incomplete_run(run, frames):
                asked = (metric for metric in METRICS.values() if metric.name in metric_names(spec))
                of_parameters = any(metric.level in OF_REPEATS for metric in asked)
                parameters = frames.read("parameters", PARAMETER_COLUMNS) if of_parameters else None
                lines = table_lines(frames, spec)
                yield build_table(lines, spec, row_selection(run), parameters, run.suite.metrics)


def _specs(run: RunFolder) -> list[dict[str, Any]]:
    """The [[table]] entries of a run."""
    given = [entry.model_dump(exclude_none=True) for entry in run.suite.table]
    return given or [dict(_DEFAULT_TABLE)]


def table_lines(frames: Frames, spec: Mapping[str, Any]) -> "pd.DataFrame":
    """Return the data of a table: a row per joint, way of estimation or parameter where an axis
    needs it, else one per cell; with all fields only where it has not those of its axes, for the
    message."""
    select = spec.get("select") or ()  # an expression, or values of fields
    chosen = condition(select).fields if isinstance(select, str) else frozenset(select)
    axes = (*spec["rows"], *spec["columns"])
    kind = next((kind for axis, kind in _FRAMES.items() if axis in axes), "cells")
    fields = table_fields((*axes, *chosen), metric_names(spec))
    if kind != "cells":
        # Fields with one value in all cells: lines would repeat it, and no note names it.
        unused = fields.intersection({*SWEEPABLE, *SETTING}).difference(axes, chosen)
        cells = replace(frames, fields=unused).cells
        constant = (name for name in unused if name in cells)
        fields -= {name for name in constant if cells[name].nunique(dropna=False) < 2}
    lines: pd.DataFrame = getattr(replace(frames, fields=fields), kind)
    return lines if {*axes} <= {*lines.columns} else getattr(frames, kind)


def _rankings(run: RunFolder, frames: Frames) -> tuple[Ranking, ...]:
    cells, suite = frames.cells, run.suite
    found: list[Ranking] = []
    for entry in suite.ranking:
        with _incomplete_run(run, frames):
            known = entry_with_cells(entry.model_dump(exclude_none=True), cells)
            found += rank_cells(cells, known, row_selection(run), suite.metrics)
    return correct_together(found)


@contextmanager
def _incomplete_run(run: RunFolder, frames: Frames) -> Iterator[None]:
    """Leave a table out while cells have no row, and where --set changed the suite that it was
    written for: it may have nothing to show."""
    try:
        yield
    except UsageError:
        made = run.suite.origin
        as_written = made is None or "--set" not in shlex.split(made.command or "")
        if as_written and len(frames.cells) == len(run.planned):
            raise


def _write_tables(
    run: RunFolder,
    frames: Frames,
    tables: tuple[Table, ...],
    ranked: tuple[Ranking, ...],
    listings: tuple[TextTable, ...],
    origin: Origin,
) -> None:
    """Write every table as Markdown, CSV, LaTeX and JSON, and all numbers as LaTeX macros."""
    files: dict[str, str] = {}
    of_rankings = tuple(chain.from_iterable(map(ranking_tables, ranked)))
    for form in FORMATS:
        suffix = "tex" if form == "latex" else form
        for made in (*tables, *of_rankings):
            files[f"{made.name}.{suffix}"] = _text(made, form, origin)
        for listing in listings:
            files[f"{listing.name}.{suffix}"] = text_of(listing, form, origin)
    files["numbers.tex"] = macro_text((*tables, *map(verdict_table, ranked)), origin)
    specs = [entry.model_dump() for entry in run.suite.macro]
    if specs:
        with _incomplete_run(run, frames):
            files["macros.tex"] = suite_macro_text(
                frames.cells, specs, row_selection(run), run.suite.metrics, origin
            )
    for name, text in files.items():
        path = run.path / "tables" / name
        try:
            write_whole(path, text)
        except OSError as error:
            raise UsageError(
                f"{str(path)!r} cannot be written ({reason_of(error)}); remove it or free the disk."
            ) from error


def _text(table: Table, form: str, origin: Origin) -> str:
    """Text of a table; the origin is a comment in LaTeX alone."""
    if form == "latex":
        return to_latex(table, origin)
    return {"md": to_markdown, "csv": to_csv, "json": to_json}[form](table)
