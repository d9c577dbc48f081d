"""Rows from other code: compare what a row depended on with what is there now."""

from collections.abc import Callable, Iterable, Mapping

from sysid_bench.experiments.loaded_sources import stale_sources
from sysid_bench.harness.plan import Cell
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


def stale_note(count: int) -> str:
    """Return the sentence on rows of other code; empty for none."""
    if not count:
        return ""
    rows = "1 row is" if count == 1 else f"{count} rows are"
    return (
        f"{rows} from other code, models or libraries than now; --rerun stale computes them again."
    )
