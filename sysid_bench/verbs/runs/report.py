"""The commands `report` and `table`: from the rows of a run to paper and screen."""

import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.errors import UsageError, reason_of, unknown_name
from sysid_bench.evaluation.repeat_statistic import PARAMETER_COLUMNS, SETTING
from sysid_bench.harness.cell import fields
from sysid_bench.harness.fingerprint import other_code, stale_note
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.build_table import build_table, table_fields
from sysid_bench.reporting.figures import figure, svg_element
from sysid_bench.reporting.html import RunView, write_report
from sysid_bench.reporting.latex import Origin, macro_text, suite_macro_text, to_latex
from sysid_bench.reporting.ranking import Ranking, entry_with_cells, rank_cells
from sysid_bench.reporting.ranking_figures import profile
from sysid_bench.reporting.ranking_tables import ranking_tables, verdict_table
from sysid_bench.reporting.report_data import JOINT_SCORES
from sysid_bench.reporting.sections import JOINT_COLUMNS
from sysid_bench.reporting.selection import SWEEPABLE, Choose, metric_names
from sysid_bench.reporting.tables import Table
from sysid_bench.reporting.text_table import TextTable
from sysid_bench.reporting.writers import to_csv, to_json, to_markdown
from sysid_bench.verbs.runs.claims import claims_of
from sysid_bench.verbs.runs.paper_output import (
    paper_tables,
    text_of,
    torque_samples,
    write_paper_figures,
)
from sysid_bench.verbs.runs.recordings import recording_notes
from sysid_bench.verbs.runs.run_folder import no_rows, open_run
from sysid_bench.verbs.runs.run_origin import run_origin
from sysid_bench.words import JOINT, OF_REPEATS, PARAMETER, STD_FROM

if TYPE_CHECKING:
    import pandas as pd

    from sysid_bench.harness.frames import Frames
    from sysid_bench.harness.stored_run import RunFolder

DEFAULT_TABLE: Final[Mapping[str, Any]] = {
    "name": "main",
    "title": "Held-out torque error",
    "rows": ["robot", "payload"],
    "columns": ["task", "noise", "estimator"],
    "cells": {"metric": "torque_error", "stat": "median", "interval": "iqr"},
    "best": "min-bold",
}
"""The table of a suite that names none."""

FORMATS: Final = ("md", "csv", "latex", "json")
_FRAMES: Final = {JOINT: "by_joint", STD_FROM: "by_std_from", PARAMETER: "by_parameter"}
"""Data with a row for each value of an axis, made when it is read."""
_SUFFIXES: Final = {"md": "md", "csv": "csv", "latex": "tex", "json": "json"}


def report(folder: str | Path) -> Path:
    """Write tables/, figures/ and report.html of a run from its folder alone; return its path.

    Raises UsageError for a folder without rows.
    """
    run_folder, frames = _opened(folder)
    tables, ranked = tuple(_tables(run_folder, frames)), _rankings(run_folder, frames)
    note = _stale_note(run_folder)
    tested = claims_of(run_folder)
    listings = (*paper_tables(run_folder), *([tested.listing] if tested else []))
    origin = replace(run_origin(run_folder, len(frames.cells)), note=note)
    for name in ("tables", "figures"):
        (run_folder.path / name).mkdir(exist_ok=True)
    _write_tables(run_folder.path / "tables", tables, ranked, listings, origin)
    _write_macros(run_folder, frames, origin)
    _draw(run_folder.path / "figures", tables, ranked)
    drawn = write_paper_figures(run_folder, run_folder.path / "figures")
    return write_report(
        RunView(
            folder=run_folder.path,
            suite=parse_toml(read_text(run_folder.path / "run.toml")),
            env=run_folder.environment,
            cells=frames.cells,
            joints=frames.read("joints", {*JOINT_COLUMNS, *JOINT_SCORES}),
            tables=tables,
            rankings=ranked,
            metrics=run_folder.suite.metrics,
            recordings=recordings(run_folder),
            command=origin.command,
            listings=listings,
            notes=(*filter(None, [note]), *recording_notes(run_folder)),
            torques=torque_samples(run_folder),
            pictures=tuple((title, svg_element(path.read_bytes())) for title, path in drawn),
        )
    )


def _opened(folder: str | Path) -> "tuple[RunFolder, Frames]":
    """A run with rows and its data."""
    run_folder = open_run(folder)
    frames = run_folder.frames()
    if len(frames.cells) == 0:
        raise no_rows(run_folder)
    return run_folder, frames


def result_of(
    folder: str | Path,
) -> "tuple[RunFolder, Frames, tuple[Table, ...], tuple[Ranking, ...]]":
    """A run, its data, its tables with a figure and its rankings; UsageError for a folder without
    rows."""
    run_folder, frames = _opened(folder)
    names = [spec["name"] for spec in _specs(run_folder) if not spec.get("metrics")]
    made = (one for name in names for one in _tables(run_folder, frames, name))
    tables = tuple(one for one in made if one.has_figure)
    return run_folder, frames, tables, _rankings(run_folder, frames)


def table_of(folder: str | Path, name: str) -> "Table | None":
    """One table of a run, None where none has the name; UsageError for a folder without rows."""
    run_folder, frames = _opened(folder)
    return _by_name(_tables(run_folder, frames, name)).get(name)


def _stale_note(run_folder: "RunFolder") -> str:
    """Sentence on the rows that are from other code than now; empty for none."""
    return stale_note(other_code(run_folder, run_folder.row_counts()))


def table(folder: str | Path, name: str, form: str = "md") -> str:
    """One table of a run as Markdown ("md"), CSV, LaTeX or JSON; UsageError for an unknown name."""
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    run_folder, frames = _opened(folder)
    origin = run_origin(run_folder, len(frames.cells))
    if form == "latex":
        origin = replace(origin, note=_stale_note(run_folder))
    tables = _by_name(_tables(run_folder, frames, name))
    if name in tables:
        return _text(tables[name], form, origin)
    if name in [entry.name for entry in run_folder.suite.paper]:
        return text_of(_listing(run_folder, name), form, origin)
    # Rankings resample thousands of times: made only where one is named.
    return _text(_table_of_ranking(run_folder, frames, name), form, origin)


def _table_of_ranking(run_folder: "RunFolder", frames: "Frames", name: str) -> Table:
    tables = _by_name(_ranking_tables(_rankings(run_folder, frames)))
    if name not in tables:
        tables |= _by_name(_tables(run_folder, frames))
        raise unknown_name("table", name, tables)
    return tables[name]


def _by_name(tables: Iterable[Table]) -> dict[str, Table]:
    return {made.name: made for made in tables}


def _listing(run_folder: "RunFolder", name: str) -> TextTable:
    """Table of texts of a [[paper]] entry; raise UsageError where there is none to print."""
    for listing in paper_tables(run_folder, name):
        return listing
    raise UsageError(f"{name!r} has no ok cell yet, or is a figure: see figures/.")


def _ranking_tables(ranked: Iterable[Ranking]) -> Iterator[Table]:
    """Tables of all rankings."""
    return chain.from_iterable(map(ranking_tables, ranked))


def summary_tables(folder: str | Path) -> list[str]:
    """Every table of a run as Markdown, for the terminal."""
    run = open_run(folder)
    frames = run.frames()
    origin = run_origin(run, len(frames.cells))
    orders = map(verdict_table, _rankings(run, frames))
    return [_text(made, "md", origin) for made in (*_tables(run, frames), *orders)]


def recordings(run_folder: "RunFolder") -> dict[str, str]:
    """Path of each cell's recording, relative to the run, by cell id."""
    found = sorted((run_folder.path / "artifacts").glob("*/*.rrd"))
    return {file.parent.name: str(file.relative_to(run_folder.path)) for file in found}


def _write_tables(
    folder: Path,
    tables: tuple[Table, ...],
    ranked: tuple[Ranking, ...],
    listings: tuple[TextTable, ...],
    origin: Origin,
) -> None:
    """Every table as Markdown, CSV, LaTeX and JSON, and all numbers as LaTeX macros."""
    for form, suffix in _SUFFIXES.items():
        for made in (*tables, *_ranking_tables(ranked)):
            _put(folder / f"{made.name}.{suffix}", _text(made, form, origin))
        for listing in listings:
            _put(folder / f"{listing.name}.{suffix}", text_of(listing, form, origin))
    orders = tuple(map(verdict_table, ranked))
    _put(folder / "numbers.tex", macro_text((*tables, *orders), origin))


def _write_macros(run_folder: "RunFolder", frames: "Frames", origin: Origin) -> None:
    """tables/macros.tex of a suite with [[macro]]."""
    suite, specs = run_folder.suite, [entry.model_dump() for entry in run_folder.suite.macro]
    if specs:
        with _incomplete_run(run_folder, frames):
            text = suite_macro_text(
                frames.cells, specs, row_selection(run_folder), suite.metrics, origin
            )
            _put(run_folder.path / "tables" / "macros.tex", text)


def _draw(folder: Path, tables: tuple[Table, ...], ranked: tuple[Ranking, ...]) -> None:
    drawn = [made for made in tables if made.has_figure]
    for suffix in ("pdf", "svg"):
        for made in drawn:
            figure(made, folder / f"{made.name}.{suffix}")
        for ranking in ranked:
            profile(ranking, folder / f"{ranking.name}.{suffix}")


def _tables(run_folder: "RunFolder", frames: "Frames", name: str | None = None) -> Iterator[Table]:
    """The tables of a run, or the one with a name."""
    suite = run_folder.suite
    for spec in _specs(run_folder):
        if name in (None, spec["name"]):
            with _incomplete_run(run_folder, frames):
                parameters = _parameters(frames, spec)
                lines = _lines(frames, spec)
                yield build_table(lines, spec, row_selection(run_folder), parameters, suite.metrics)


def _specs(run_folder: "RunFolder") -> list[dict[str, Any]]:
    """The [[table]] entries of a run."""
    given = [entry.model_dump(exclude_none=True) for entry in run_folder.suite.table]
    return given or [dict(DEFAULT_TABLE)]


def _parameters(frames: "Frames", spec: Mapping[str, Any]) -> "pd.DataFrame | None":
    """Parameters of all cells, for a table whose metrics need them."""
    asked = (metric for metric in METRICS.values() if metric.name in metric_names(spec))
    needed = any(metric.level in OF_REPEATS for metric in asked)
    return frames.read("parameters", PARAMETER_COLUMNS) if needed else None


def _lines(frames: "Frames", spec: Mapping[str, Any]) -> "pd.DataFrame":
    """Data of a table: a row per joint, way of estimation or parameter where an axis needs it, else
    one per cell; with all fields only where it has not those of its axes, for the message."""
    axes, chosen = (*spec["rows"], *spec["columns"]), _selected_fields(spec)
    kind = next((kind for axis, kind in _FRAMES.items() if axis in axes), "cells")
    fields = table_fields((*axes, *chosen), metric_names(spec))
    if kind != "cells":
        fields -= _constant(
            frames, fields.intersection({*SWEEPABLE, *SETTING}).difference(axes, chosen)
        )
    lines: pd.DataFrame = getattr(replace(frames, fields=fields), kind)
    return lines if {*axes} <= {*lines.columns} else getattr(frames, kind)


def _selected_fields(spec: Mapping[str, Any]) -> frozenset[str]:
    """Fields by which a table selects its cells, with an expression or with values."""
    select = spec.get("select") or ()
    return _parsed(select).fields if isinstance(select, str) else frozenset(select)


def _constant(frames: "Frames", fields: frozenset[str]) -> set[str]:
    """Fields with one value in all cells: lines by joint would repeat it, and no note names it."""
    cells = replace(frames, fields=fields).cells
    return {name for name in fields if name in cells and cells[name].nunique(dropna=False) < 2}


def _rankings(run_folder: "RunFolder", frames: "Frames") -> tuple[Ranking, ...]:
    cells, suite = frames.cells, run_folder.suite
    found: list[Ranking] = []
    for entry in suite.ranking:
        with _incomplete_run(run_folder, frames):
            known = entry_with_cells(entry.model_dump(exclude_none=True), cells)
            found += rank_cells(cells, known, row_selection(run_folder), suite.metrics)
    return tuple(found)


@contextmanager
def _incomplete_run(run_folder: "RunFolder", frames: "Frames") -> Iterator[None]:
    """Leave a table out while cells have no row, and where --set changed the suite that it was
    written for: it may have nothing to show."""
    try:
        yield
    except UsageError:
        made = run_folder.suite.origin
        as_written = made is None or "--set" not in shlex.split(made.command or "")
        if as_written and len(frames.cells) == len(run_folder.planned):
            raise


def holds(expression: str, cell: Mapping[str, Any]) -> bool:
    """True where a cell meets a condition."""
    return _parsed(expression).holds(cell)


_parsed = cache(Expression.parse)


def row_selection(run_folder: "RunFolder") -> Choose:
    """Return a test of conditions on rows of a run: with the fields of their planned cell, such as
    noise.tau, where a row alone has not all that a condition reads."""
    planned: dict[str, dict[str, Any]] = {}

    def choose(expression: str, row: Mapping[str, Any]) -> bool:
        if _parsed(expression).fields <= row.keys() or "id" not in row:
            return holds(expression, row)
        if not planned:
            planned.update({cell.id: fields(cell) for cell in run_folder.plan.cells})
        return holds(expression, {**row, **planned.get(row["id"], {})})

    return choose


def _text(table: Table, form: str, origin: Origin) -> str:
    """Text of a table; the origin is a comment in LaTeX alone."""
    if form == "latex":
        return to_latex(table, origin)
    return {"md": to_markdown, "csv": to_csv, "json": to_json}[form](table)


def _put(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise UsageError(
            f"{str(path)!r} cannot be written ({reason_of(error)}); remove it or free the disk."
        ) from error
