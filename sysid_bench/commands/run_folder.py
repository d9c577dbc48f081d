"""Run folders as verbs open them: rows, cells by their ids, origin of numbers, files."""

import os
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.errors import UsageError, first_names
from sysid_bench.harness.cell import fields
from sysid_bench.harness.fingerprint import other_code, stale_note
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.reporting.latex import Origin
from sysid_bench.reporting.selection import Choose


def open_run(folder: str | Path) -> RunFolder:
    """Open a run folder: `.cells`, `.parameters` and `.joints` are pandas DataFrames."""
    return RunFolder.open(Path(folder))


def no_rows(run: RunFolder) -> UsageError:
    """Return the error of what needs rows, on a run that has none."""
    folder = str(run.path)
    command = f"sysid-bench run {shlex.quote(folder)}"
    return UsageError(f"{folder!r} has no rows yet; run it first: '{command}'.")


def find_cell(run: RunFolder, identifier: str) -> str:
    """Return the id that begins with `identifier`; raise UsageError for none or several."""
    ids = run.planned
    found = [i for i in ids if identifier and i.startswith(identifier)]
    if len(found) == 1:
        return found[0]
    matches = f"No cell id begins with {identifier!r}"
    if found:
        matches = f"{len(found)} cell ids begin with {identifier!r}: {', '.join(found[:8])}"
    listing = f"sysid-bench cells {shlex.quote(str(run.path))}"
    raise UsageError(f"{matches}; '{listing}' lists the {len(ids)} cells of the run.")


def rows_with(run: RunFolder, condition: Expression) -> dict[str, bool]:
    """Return for each planned cell with a row whether that, with the fields of the cell, meets a
    condition; one row is in memory at a time."""
    cells = {cell.id: cell for cell in run.plan.cells}
    met = dict[str, bool]()
    for row, _ in run.rows_with_origin():
        if isinstance(row, dict) and row["id"] in cells:
            met[row["id"]] = condition.holds({**row, **fields(cells[row["id"]])})
    return met


condition = cache(Expression.parse)
"""Condition of a text, each read once."""


def holds(text: str, cell: Mapping[str, Any]) -> bool:
    """Return True where a cell meets the condition of a text."""
    return condition(text).holds(cell)


def row_selection(run: RunFolder) -> Choose:
    """Return a test of conditions on rows of a run: with the fields of their planned cell, such as
    noise.tau, where a row alone has not all that a condition reads."""
    planned: dict[str, dict[str, Any]] = {}

    def choose(text: str, row: Mapping[str, Any]) -> bool:
        if condition(text).fields <= row.keys() or "id" not in row:
            return holds(text, row)
        if not planned:  # read once, and not at all where rows have all fields
            planned.update({cell.id: fields(cell) for cell in run.plan.cells})
        return holds(text, {**row, **planned.get(row["id"], {})})

    return choose


def rerun_command(folder: str | Path, cell: str) -> str:
    """Return the command that computes a cell again."""
    return f"sysid-bench run {shlex.quote(str(folder))} --select 'id == \"{cell}\"' --rerun all"


def damage_note(damaged: Sequence[str]) -> str:
    """Return the sentence on rows of `RunFolder.damaged`; empty for none."""
    if not damaged:
        return ""
    lines = "1 row is" if len(damaged) == 1 else f"{len(damaged)} rows are"
    return (
        f"{lines} damaged or changed after being written, and counted as open: "
        f"{first_names(damaged)}; run again: only cells without a row run."
    )


def row_notes(run: RunFolder) -> str:
    """Return sentences on damaged rows and on those of other code than now; empty for none."""
    stale = stale_note(other_code(run, run.row_counts()))
    return " ".join(filter(None, [damage_note(run.damaged), stale]))


def run_origin(run: RunFolder, rows: int) -> Origin:
    """Return the origin of the tables of a run with so many rows: its name, the hash of its cells
    and the command that makes it, with the selection of cells unless the run is whole."""
    cells = sorted(run.planned)
    made = run.suite.origin
    command = (made.command if made else None) or f"sysid-bench run {shlex.quote(run.suite.name)}"
    if made and rows != len(cells):
        command = " ".join([command, *map(shlex.quote, made.selection)])
    return Origin(run.path.name, canonical_hash(cells)[:12], command)


def write_whole(file: Path, text: str) -> None:
    """Write a file whole or not at all: a full disk must not cost what was there."""
    # The process is part of the name: two commands may write one file at a time.
    part = file.with_name(f".{file.name}.{os.getpid()}")
    file.parent.mkdir(parents=True, exist_ok=True)
    part.write_text(text, encoding="utf-8")
    part.replace(file)
