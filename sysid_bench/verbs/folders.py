"""Run folders and their cells."""

from pathlib import Path

from sysid_bench.errors import UsageError
from sysid_bench.harness.store import RunFolder


def open_run(folder: str | Path) -> RunFolder:
    """Open a run folder: `.cells`, `.parameters` and `.joints` are pandas DataFrames."""
    return RunFolder.open(Path(folder))


def find_cell(run_folder: RunFolder, identifier: str) -> str:
    """Return the id that begins with `identifier`; raise UsageError for none or several."""
    ids = run_folder.planned
    found = [i for i in ids if identifier and i.startswith(identifier)]
    if len(found) == 1:
        return found[0]
    matches = _matches_text(identifier, found)
    raise UsageError(f"{matches}; the run has {len(ids)} cells, listed in its plan.jsonl.")


def _matches_text(identifier: str, found: list[str]) -> str:
    if not found:
        return f"No cell id begins with {identifier!r}"
    return f"{len(found)} cell ids begin with {identifier!r}: {', '.join(found[:8])}"
