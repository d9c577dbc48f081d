"""The command `cells`: the planned cells of a run with what they gave, selected and sorted."""

import hashlib
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.result import Result, value_text
from sysid_bench.errors import unknown_name
from sysid_bench.harness.cell import fields
from sysid_bench.harness.plan import Plan
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.selection import label
from sysid_bench.reporting.writers import markdown_text, table_line
from sysid_bench.verbs.runs.repeat_difference import SAME, repeat_difference
from sysid_bench.verbs.runs.run_folder import open_run
from sysid_bench.words import LABELS

OPEN: Final = "open"
"""Status of a cell without a row."""
_SCORE: Final = "torque_error"
_ALWAYS: Final = ("id", "status")
_LAST_BITS: Final = "last_bits"


@dataclass(frozen=True, eq=False, repr=False)
class CellsResult(Result):
    """Cells of a run, each with the `columns`, its `reason` and the `command` that reproduces it;
    `planned` is the number of all cells of the run."""

    folder: str
    planned: int
    columns: list[str]
    cells: list[dict[str, Any]]

    def summary(self) -> str:
        """A table of all cells as Markdown, and their number."""
        return self.text()

    def text(self, limit: int | None = None, *, long: bool = False) -> str:
        """Table of the first `limit` cells as Markdown; where `long`, the reason and the command of
        each below."""
        shown = self.cells[:limit]
        parts = [self._table(shown), *(_details(cell) for cell in shown if long)]
        hidden = len(self.cells) - len(shown)
        more = f", {hidden} of them not shown" if hidden else ""
        count = f"{len(self.cells)} of {self.planned} cells{more}"
        return "\n\n".join([*parts, count + self._edges()])

    def _edges(self) -> str:
        """Number of cells whose answer depends on the last bits of their data, where asked."""
        if _LAST_BITS not in self.columns:
            return ""
        edges = sum(cell[_LAST_BITS] != SAME for cell in self.cells)
        return f"; {edges} give another answer where the last bits of their data differ"

    def _table(self, cells: Sequence[Mapping[str, Any]]) -> str:
        sides = ["---:" if name in METRICS or name == "repeat" else "---" for name in self.columns]
        rows = ([_cell_text(cell[name]) for name in self.columns] for cell in cells)
        return "\n".join(map(table_line, [self.columns, sides, *rows]))


def _cell_text(value: Any) -> str:
    if isinstance(value, float):
        return value_text(value)
    return "-" if value is None else markdown_text(label(value))


def _details(cell: Mapping[str, Any]) -> str:
    reason = f"{cell['status']}: {cell['reason']}" if cell["reason"] else str(cell["status"])
    return f"{cell['id']} {markdown_text(reason)}\n    {cell['command']}"


def cells(
    folder: str | Path,
    select: str | None = None,
    sort: str | None = None,
    show: Sequence[str] = (),
    *,
    sample: int | None = None,
    repeats: int = 0,
) -> CellsResult:
    """Return the cells of a run that meet an expression of cells, `status` and metrics, in the
    order of the plan or sorted by a field, "-FIELD" from the largest; cells without it come last.

    The columns are the labels in which these cells differ, the status, the torque error, the field
    of the order and those of `show`. `sample`: so many of the selected cells, which their ids
    decide. `repeats`: each cell is executed again, on its data and on so many copies with other
    last bits; the column `last_bits` states what that changes, and such cells come first.
    Raises UsageError for an unknown field.
    """
    run = open_run(folder)
    plan = run.plan
    known = {*plan.fields, *METRICS, *run.suite.metrics, "status", "reason"}
    condition = None if select is None else Expression.parse(select, known)
    by = (sort or "").removeprefix("-")
    wanted = [*filter(None, [by]), *show]
    _check_fields(wanted, known)
    found = _merged(plan, run.rows().rows)
    if condition is not None:
        found = list(filter(condition.holds, found))
    if sample is not None:
        found = _sampled(found, sample)
    if by:
        found = _sorted(found, by, is_falling=str(sort).startswith("-"))
    if repeats:
        found = _with_last_bits(run, found, repeats)
        wanted = [*wanted, _LAST_BITS]
    columns = _columns(found, [_SCORE, *wanted])
    path = str(run.path)
    return CellsResult(path, len(plan.cells), columns, [_listed(c, columns, path) for c in found])


def _check_fields(names: Sequence[str], known: set[str]) -> None:
    for name in names:
        if name not in known:
            raise unknown_name("field of the cells", name, known)


def _sampled(cells: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """So many of the cells in their order: those whose ids have the smallest hashes."""
    order = sorted(cells, key=lambda cell: hashlib.sha256(cell["id"].encode()).digest())
    kept = {cell["id"] for cell in order[:count]}
    return [cell for cell in cells if cell["id"] in kept]


def _with_last_bits(
    run: RunFolder, cells: Sequence[dict[str, Any]], repeats: int
) -> list[dict[str, Any]]:
    """Cells with what the last bits of their data change; those that it changes first."""
    texts = repeat_difference(
        run, [cell["id"] for cell in cells if cell["status"] != OPEN], repeats
    )
    found = [{**cell, _LAST_BITS: texts[cell["id"]]} for cell in cells if cell["id"] in texts]
    return sorted(found, key=lambda cell: cell[_LAST_BITS] == SAME)


def _merged(plan: Plan, rows: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Fields of each cell with those of its row; labels are in `labels`."""
    open_row = {"status": OPEN, "reason": "has not run yet"}
    return [
        {**open_row, **rows.get(cell.id, {}), **fields(cell), "labels": cell.first_fields}
        for cell in plan.cells
    ]


def _sorted(cells: Sequence[dict[str, Any]], by: str, *, is_falling: bool) -> list[dict[str, Any]]:
    """Cells by the value of a field; numbers before texts, cells without a value last."""

    def key(cell: Mapping[str, Any]) -> tuple[bool, float, str]:
        value = cell["labels"].get(by, cell.get(by))
        is_number = isinstance(value, (int, float))
        return not is_number, float(value) if is_number else 0.0, "" if is_number else label(value)

    valued = [cell for cell in cells if cell["labels"].get(by, cell.get(by)) is not None]
    without = [cell for cell in cells if cell["labels"].get(by, cell.get(by)) is None]
    return sorted(valued, key=key, reverse=is_falling) + without


def _columns(cells: Sequence[Mapping[str, Any]], asked: Sequence[str]) -> list[str]:
    """Columns of a list: what these cells differ in, then what was asked for."""
    differing: list[str] = []
    for name in (*LABELS, "repeat"):
        if not any(_follows(cells, name, other) for other in ("", *differing)):
            differing.append(name)
    first, last = _ALWAYS
    return list(dict.fromkeys([first, *differing, last, *asked]))


def _follows(cells: Sequence[Mapping[str, Any]], name: str, other: str) -> bool:
    """True where each value of another label has one value of this one: it adds nothing."""
    pairs = {(label(c["labels"].get(other, "")), label(c["labels"][name])) for c in cells}
    return len(pairs) == len({first for first, _ in pairs})


def _listed(cell: Mapping[str, Any], columns: Sequence[str], folder: str) -> dict[str, Any]:
    """The columns of a cell, its reason, and the command that reproduces it."""
    values = {name: cell["labels"].get(name, cell.get(name)) for name in columns}
    select = f'id == "{cell["id"]}"'
    command = f"sysid-bench run {shlex.quote(folder)} --select '{select}' --rerun all"
    return {**values, "reason": cell["reason"], "command": command}
