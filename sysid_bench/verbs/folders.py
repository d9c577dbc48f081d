"""Run folders and their cells, for every verb that looks at a run."""

from pathlib import Path
from typing import TYPE_CHECKING

from sysid_bench.errors import unknown_name

if TYPE_CHECKING:
    from sysid_bench.harness.store import RunFolder


def open_run(folder: str | Path) -> "RunFolder":
    """A run folder: `.cells`, `.parameters`, `.joints` are pandas DataFrames."""
    from sysid_bench.harness.store import RunFolder

    return RunFolder.open(Path(folder))


def find_cell(run_folder: "RunFolder", identifier: str) -> str:
    """The id that begins with `identifier`; raises UsageError for none or several."""
    ids = [cell.id for cell in run_folder.plan.cells]
    found = [i for i in ids if i.startswith(identifier)] if identifier else []
    if len(found) != 1:
        what = f"{len(found)} cells begin with it" if found else "no cell has it"
        raise unknown_name("cell", identifier, found[:20] or ids[:20], f"({what}; of {len(ids)}.)")
    return found[0]
