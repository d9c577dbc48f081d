"""Run folders and their cells."""

import shlex
from pathlib import Path

from sysid_bench.errors import UsageError
from sysid_bench.harness.cell import fields
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.expression import Expression


def open_run(folder: str | Path) -> RunFolder:
    """Open a run folder: `.cells`, `.parameters` and `.joints` are pandas DataFrames."""
    return RunFolder.open(Path(folder))


def no_rows(run_folder: RunFolder) -> UsageError:
    """The error of what needs rows, on a run that has none."""
    folder = str(run_folder.path)
    run = shlex.quote(folder)
    return UsageError(f"{folder!r} has no rows yet; run it first: 'sysid-bench run {run}'.")


def find_cell(run_folder: RunFolder, identifier: str) -> str:
    """Return the id that begins with `identifier`; raise UsageError for none or several."""
    ids = run_folder.planned
    found = [i for i in ids if identifier and i.startswith(identifier)]
    if len(found) == 1:
        return found[0]
    matches = _matches_text(identifier, found)
    listing = f"sysid-bench cells {shlex.quote(str(run_folder.path))}"
    raise UsageError(f"{matches}; '{listing}' lists the {len(ids)} cells of the run.")


def rows_with(run_folder: RunFolder, condition: Expression) -> dict[str, bool]:
    """Return for each planned cell with a row whether that, with the fields of the cell, meets a
    condition; one row is in memory at a time."""
    cells = {cell.id: cell for cell in run_folder.plan.cells}
    met = dict[str, bool]()
    for row, _ in run_folder.rows_with_origin():
        if isinstance(row, dict) and row["id"] in cells:
            met[row["id"]] = condition.holds({**row, **fields(cells[row["id"]])})
    return met


def _matches_text(identifier: str, found: list[str]) -> str:
    if not found:
        return f"No cell id begins with {identifier!r}"
    return f"{len(found)} cell ids begin with {identifier!r}: {', '.join(found[:8])}"
