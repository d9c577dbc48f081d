"""Run folders and their cells."""

from pathlib import Path

from sysid_bench.errors import UsageError
from sysid_bench.harness.store import RunFolder


def open_run(folder: str | Path) -> RunFolder:
    """Open a run folder: `.cells`, `.parameters` and `.joints` are pandas DataFrames."""
    return RunFolder.open(Path(folder))


def find_cell(run_folder: RunFolder, identifier: str) -> str:
    """Return the id that begins with `identifier`; raise UsageError for none or several."""
    ids = [cell.id for cell in run_folder.plan.cells]
    found = [i for i in ids if i.startswith(identifier)] if identifier else []
    if len(found) != 1:
        count = f"{len(found)} cell ids begin" if found else "No cell id begins"
        shown = f": {', '.join(found[:8])}" if found else ""
        raise UsageError(
            f"{count} with {identifier!r}{shown}; the run has {len(ids)} cells, listed "
            "in its plan.jsonl."
        )
    return found[0]
