"""Verbs `status` and `cell`: the progress of a run, and one of its rows."""

import json
import shlex
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sysid_bench import errors
from sysid_bench.commands.request import Request, argument, python_function
from sysid_bench.commands.result import Result

if TYPE_CHECKING:
    from sysid_bench.harness.coverage import RowCounts
    from sysid_bench.harness.stored_run import RunFolder

_SHOWN: Final = 3
"""Reasons at the end of a run."""


class Status(Request["StatusResult"]):
    """Show the progress of a run, and the reasons of failures."""

    folder: str | Path = argument("RUN", complete="runs folders")

    def run(self) -> "StatusResult":
        """Return the progress of a run and the reasons of cells that are not `ok`."""
        from sysid_bench.commands.run_folder import open_run
        from sysid_bench.harness.fingerprint import other_code

        run = open_run(self.folder)
        counts = run.row_counts()
        statuses = Counter[str]()
        for kind, count in counts.rows.items():
            statuses[kind.status] += count
        return StatusResult(
            folder=str(run.path),
            cells=counts.cells,
            open=counts.cells - statuses.total(),
            statuses=dict(sorted(statuses.items(), key=lambda pair: (-pair[1], pair[0]))),
            reasons=_reasons(counts),
            other_code=other_code(run, counts),
            damaged=[*run.damaged],
        )


class Cell(Request["CellResult"]):
    """Show one row, its traceback, and the command that reproduces it."""

    folder: str | Path = argument("RUN", complete="runs folders")
    identifier: str = argument("ID", complete="cells")

    def run(self) -> "CellResult":
        """Return the row of a cell, by a unique beginning of its id, and the command that
        reproduces it. Raises UsageError where none or several cells begin with it."""
        from sysid_bench.commands.run_folder import find_cell, open_run, rerun_command

        run = open_run(self.folder)
        full = find_cell(run, self.identifier)
        missing = {"id": full, "status": "open", "reason": "has not run yet"}
        return CellResult(row=run.row(full) or missing, command=rerun_command(run.path, full))


status = python_function(Status, "status")
cell = python_function(Cell, "cell")


@dataclass(frozen=True, eq=False, repr=False)
class StatusResult(Result):
    """Progress of a run: planned cells, rows by status, reasons with their counts, and the number
    of rows from `other_code`, models or libraries than there are now; `damaged` rows, changed after
    they were written, whose cells count as open."""

    folder: str
    cells: int
    open: int
    statuses: dict[str, int]
    reasons: list[dict[str, Any]]
    other_code: int
    damaged: list[str]

    def summary(self) -> str:
        """Counts, then one line for each reason."""
        from sysid_bench.commands.run_folder import damage_note
        from sysid_bench.harness.fingerprint import stale_note

        counts = status_counts(self.statuses) or "no rows"
        lines = [f"{self.cells} cells: {counts}, {self.open} open"]
        lines += map(_reason_line, self.reasons)
        notes = damage_note(self.damaged), stale_note(self.other_code)
        return "\n".join([*lines, *filter(None, notes)])


@dataclass(frozen=True, eq=False, repr=False)
class CellResult(Result):
    """Row of a cell with its fields as keys; `command` reproduces it."""

    row: Mapping[str, Any]
    command: str

    def summary(self) -> str:
        """One line per field, then the traceback of a failure."""
        tables = ("joints", "parameters_table", "traceback")
        fields = {key: value for key, value in self.items() if key not in tables}
        lines = [
            f"{key:<22} {value if isinstance(value, str) else json.dumps(value)}"
            for key, value in fields.items()
        ]
        traceback = self.row.get("traceback")
        return "\n".join([*lines, f"\n{traceback}"] if traceback else lines)

    def _fields(self) -> dict[str, Any]:
        return {**self.row, "command": self.command}


def status_counts(counts: Mapping[str, int]) -> str:
    """Return counts as "3 ok, 1 failed"."""
    return ", ".join(f"{count} {status}" for status, count in counts.items())


def reason_lines(run: "RunFolder", statuses: Collection[str]) -> list[str]:
    """Return the most frequent reasons of these statuses, a line each, and where the others are."""
    reasons = [one for one in _reasons(run.row_counts()) if one["status"] in statuses]
    lines = [*map(_reason_line, reasons[:_SHOWN])]
    more = len(reasons) - len(lines)
    if more:
        command = f"sysid-bench status {shlex.quote(str(run.path))}"
        lines.append(f"  and {errors.count_text(more, 'more reason')}: {command}")
    return lines


def _reasons(counts: "RowCounts") -> list[dict[str, Any]]:
    """Statuses and reasons of rows that are not ok, the most frequent first."""
    found = Counter[tuple[str, str]]()
    for kind, count in counts.rows.items():
        found[kind.status, kind.reason] += count
    ordered = sorted(found.items(), key=lambda pair: (-pair[1], pair[0]))
    return [
        {"status": status, "reason": reason, "cells": count}
        for (status, reason), count in ordered
        if status != "ok"
    ]


def _reason_line(one: Mapping[str, Any]) -> str:
    return f"  {one['cells']} {one['status']}: {one['reason']}"
