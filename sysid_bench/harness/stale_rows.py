"""Rows from other code: compare what a row depended on with what is there now."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from sysid_bench.experiments.third_party import stale_sources
from sysid_bench.harness.cell import Cell
from sysid_bench.harness.fingerprint import cell_fingerprint, code_key
from sysid_bench.harness.row_counts import RowCounts, RowKind
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.model import Suite
from sysid_bench.types import Row


def is_stale(row: Row, fingerprint: str) -> bool:
    """True where a row depends on code, models or libraries that differ now.

    What is gone (an empty `fingerprint`, an absent file) proves nothing: such a row is not stale.
    """
    if fingerprint and row.get("fingerprint") != fingerprint:
        return True
    return bool(stale_sources(row.get("sources") or {}))


def stale_cells(
    cells: Iterable[Cell], rows: Mapping[str, Row], fingerprint: Callable[[Cell], str]
) -> list[str]:
    """Return the ids of cells whose row is stale."""
    return [
        cell.id for cell in cells if cell.id in rows and is_stale(rows[cell.id], fingerprint(cell))
    ]


def current_fingerprint(suite: Suite, robots_dir: Path | None) -> Callable[[Cell], str]:
    """Return a function that gives the fingerprint of a cell now; cells share it by their parts."""
    metrics = [entry.spec for entry in suite.metric]
    known: dict[str, str] = {}

    def fingerprint(cell: Cell) -> str:
        key = code_key(cell)
        if key not in known:
            known[key] = cell_fingerprint(cell, robots_dir, suite.folder, metrics)
        return known[key]

    return fingerprint


def other_code(folder: RunFolder, counts: RowCounts) -> int:
    """Return the number of rows of a run that are from other code, models or libraries than now."""
    fingerprint = current_fingerprint(folder.suite, folder.suite.robots_folder)
    cells = folder.cells_at({kind.cell for kind in counts.rows})
    now = {place: fingerprint(cell) for place, cell in cells.items()}
    return sum(count for kind, count in counts.rows.items() if _is_other(kind, now[kind.cell]))


def _is_other(kind: RowKind, fingerprint: str) -> bool:
    sources = json.loads(kind.sources) if kind.sources else {}
    return is_stale({"fingerprint": kind.fingerprint, "sources": sources}, fingerprint)


def stale_note(count: int) -> str:
    """Return the sentence on rows of other code; empty for none."""
    if not count:
        return ""
    rows = "1 row is" if count == 1 else f"{count} rows are"
    return (
        f"{rows} from other code, models or libraries than now; --rerun stale computes them again."
    )
