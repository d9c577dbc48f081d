"""Counts of the rows of a run by all that its status states of them.

A consolidation stores them with what it covers, so that the status of many rows reads no row.
"""

import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from sysid_bench.canonical_json import canonical
from sysid_bench.types import Row

HEAD: Final = ("id", "status", "reason", "crosscheck", "fingerprint", "losses", "sources")
"""Fields of a row on which the next run, its result and the status of a run depend."""

_MOST: Final = 10_000
"""Kinds of rows that are stored: reasons may differ in every row."""


class RowKind(NamedTuple):
    """What rows that are counted together share. `cell` is the offset (bytes) in plan.jsonl of a
    cell with the code and models of theirs, `sources` the canonical JSON of what they loaded."""

    cell: int
    status: str
    reason: str
    fingerprint: str
    sources: str


@dataclass(frozen=True)
class RowCounts:
    """Numbers of the cells of a plan, and of their rows by kind."""

    cells: int
    rows: Mapping[RowKind, int]

    @classmethod
    def of(cls, places: Mapping[str, int], rows: Mapping[str, Row]) -> "RowCounts":
        """Count the rows, by id, of planned cells; `places` are the `RowKind.cell` of all."""
        kinds = (row_kind(rows[cell], place) for cell, place in places.items() if cell in rows)
        return cls(len(places), Counter(kinds))

    @property
    def is_bounded(self) -> bool:
        """True where the counts can be stored."""
        return len(self.rows) <= _MOST

    def with_rows(self, kinds: Iterable[RowKind]) -> "RowCounts":
        """Return the counts with those of further rows."""
        return RowCounts(self.cells, Counter(self.rows) + Counter(kinds))

    def to_json(self) -> dict[str, Any]:
        """Counts as JSON has them."""
        return {"cells": self.cells, "rows": [[*kind, count] for kind, count in self.rows.items()]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "RowCounts":
        """Read counts. Raises KeyError, TypeError or ValueError for other data."""
        return cls(data["cells"], {RowKind(*kind): count for *kind, count in data["rows"]})


def row_kind(row: Row, place: int) -> RowKind:
    """Return the kind of a row, or of its fields HEAD, of a cell at a place of the plan."""
    status, reason, code = (str(row.get(key) or "") for key in ("status", "reason", "fingerprint"))
    sources = canonical(row["sources"]) if row.get("sources") else ""
    return RowKind(place, sys.intern(status), sys.intern(reason), sys.intern(code), sources)
