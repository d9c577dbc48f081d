"""Inspect a run: its progress, and single cells."""

import json
import shlex
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench import errors
from sysid_bench.commands.result import Result
from sysid_bench.harness.fingerprint import other_code, stale_note
from sysid_bench.harness.frames import RowCounts
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.verbs.runs.run_folder import find_cell, open_run

_SHOWN: Final = 3
"""Reasons at the end of a run."""


def count_text(counts: Mapping[str, int]) -> str:
    """Return counts as "3 ok, 1 failed"."""
    return ", ".join(f"{count} {status}" for status, count in counts.items())


@dataclass(frozen=True, eq=False, repr=False)
class StatusResult(Result):
    """Progress of a run: planned cells, rows by status, reasons with their counts, and the number
    of rows from `other_code`, models or libraries than there are now."""

    folder: str
    cells: int
    open: int
    statuses: dict[str, int]
    reasons: list[dict[str, Any]]
    other_code: int

    def summary(self) -> str:
        """Counts, then one line for each reason."""
        counts = count_text(self.statuses) or "no rows"
        lines = [f"{self.cells} cells: {counts}, {self.open} open"]
        lines += map(_reason_line, self.reasons)
        return "\n".join([*lines, *filter(None, [stale_note(self.other_code)])])


@dataclass(frozen=True, eq=False, repr=False)
class CellResult(Result):
    """Row of a cell with its fields as keys; `command` reproduces it."""

    row: Mapping[str, Any]
    command: str

    def summary(self) -> str:
        """One line per field, then the traceback of a failure."""
        tables = ("joints", "parameters_table", "traceback")
        fields = {key: value for key, value in self.items() if key not in tables}
        lines = [f"{key:<22} {_json_text(value)}" for key, value in fields.items()]
        traceback = self.row.get("traceback")
        return "\n".join([*lines, f"\n{traceback}"] if traceback else lines)

    def _fields(self) -> dict[str, Any]:
        return {**self.row, "command": self.command}


def _json_text(value: Any) -> str:
    """JSON of a field; a string without quotes."""
    return value if isinstance(value, str) else json.dumps(value)


def status(folder: str | Path) -> StatusResult:
    """Return the progress of a run and the reasons of cells that are not `ok`."""
    run_folder = open_run(folder)
    counts = run_folder.row_counts()
    return StatusResult(
        folder=str(run_folder.path),
        cells=counts.cells,
        open=counts.cells - sum(counts.rows.values()),
        statuses={status: count for (status,), count in _by_count(counts, ("status",))},
        reasons=_reasons(counts),
        other_code=other_code(run_folder, counts),
    )


def reason_lines(run_folder: RunFolder, statuses: Collection[str]) -> list[str]:
    """Return the most frequent reasons of these statuses, a line each, and where the others are."""
    reasons = [one for one in _reasons(run_folder.row_counts()) if one["status"] in statuses]
    lines = [*map(_reason_line, reasons[:_SHOWN])]
    more = len(reasons) - len(lines)
    if more:
        command = f"sysid-bench status {shlex.quote(str(run_folder.path))}"
        lines.append(f"  and {errors.count_text(more, 'more reason')}: {command}")
    return lines


def _reasons(counts: RowCounts) -> list[dict[str, Any]]:
    return [
        {"status": status, "reason": reason, "cells": count}
        for (status, reason), count in _by_count(counts, ("status", "reason"))
        if status != "ok"
    ]


def _reason_line(one: Mapping[str, Any]) -> str:
    return f"  {one['cells']} {one['status']}: {one['reason']}"


def _by_count(counts: RowCounts, fields: Sequence[str]) -> list[tuple[tuple[str, ...], int]]:
    """Numbers of rows by some fields of their kinds, the most frequent first."""
    found = Counter[tuple[str, ...]]()
    for kind, count in counts.rows.items():
        found[tuple(getattr(kind, field) for field in fields)] += count
    return sorted(found.items(), key=lambda pair: (-pair[1], pair[0]))


def cell(folder: str | Path, identifier: str) -> CellResult:
    """Return the row of a cell, by a unique beginning of its id, and the command that reproduces
    it. Raises UsageError where none or several cells begin with it."""
    run_folder = open_run(folder)
    full = find_cell(run_folder, identifier)
    missing = {"id": full, "status": "open", "reason": "has not run yet"}
    path = shlex.quote(str(run_folder.path))
    return CellResult(
        row=run_folder.row(full) or missing,
        command=f"sysid-bench run {path} --select 'id == \"{full}\"' --rerun all",
    )
