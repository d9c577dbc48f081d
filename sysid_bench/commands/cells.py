"""Verb `cells`: the planned cells of a run with what they gave, selected and sorted; and cells
repeated on data whose last bits differ."""

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from sysid_bench.commands.request import NOTHING, OK, Request, argument, option, python_function
from sysid_bench.commands.result import Result, value_text
from sysid_bench.commands.values import parse_condition, parse_names
from sysid_bench.errors import unknown_name
from sysid_bench.words import LABELS

if TYPE_CHECKING:
    from sysid_bench.harness.cell import Cell
    from sysid_bench.harness.stored_run import RunFolder
    from sysid_bench.types import Row

OPEN: Final = "open"
"""Status of a cell without a row."""
SAME: Final = "same"
"""Answer that the last bits of the data do not change."""
_LAST_BITS: Final = "last_bits"
_GROWTH: Final = 1e3
"""Growth of the changes beyond the condition number that an answer may show."""
_LEAST: Final = 1e-9
"""Change of the torque error, relative to the torque, that says nothing."""
_TOLERANCE: Final = 1e-6
"""Change relative to the torque error itself within which solvers stop."""
_ENDS: Final = ("status", "converged", "stop")


class Cells(Request["CellsResult"]):
    """List the cells of a run with their ids.

    Exit code 4 where none is selected.
    """

    folder: str | Path = argument("RUN", complete="runs folders")
    select: str | None = option(
        "Only cells that meet this expression of cells, status and metrics.",
        default=None, parse=parse_condition, complete="fields",
    )  # fmt: skip
    sort: str | None = option(
        "Order; -FIELD from the largest.", default=None, metavar="FIELD", complete="fields metrics"
    )
    show: Sequence[str] = option(
        "Further columns.",
        default=(), metavar="FIELD,...", parse=parse_names, complete="fields metrics",
        separated=True,
    )  # fmt: skip
    sample: int | None = option("So many of them, drawn by their ids.", default=None, least=1)
    repeats: int = option(
        "Repeat each N times on data whose last bits differ; show what that changes.",
        default=0, flags="--last-bits", least=0,
    )  # fmt: skip

    def run(self) -> "CellsResult":
        """Return the cells of a run that meet an expression of cells, `status` and metrics, in the
        order of the plan or sorted by a field, "-FIELD" from the largest; cells without it come
        last.

        The columns are the labels in which these cells differ, the status, the torque error, the
        field of the order and those of `show`. `sample`: so many of the selected cells, which their
        ids decide. `repeats`: each cell is executed again, on its data and on so many copies with
        other last bits; the column `last_bits` states what that changes, and such cells come first.
        Raises UsageError for an unknown field.
        """
        from sysid_bench.commands.run_folder import open_run, rerun_command
        from sysid_bench.metrics import METRICS

        run = open_run(self.folder)
        known = {*run.plan.fields, *METRICS, *run.suite.metrics, "status", "reason"}
        found = _selected_cells(run, self.select, known)
        by = (self.sort or "").removeprefix("-")
        wanted = [*filter(None, [by]), *self.show]
        for name in wanted:
            if name not in known:
                raise unknown_name("field of the cells", name, known)
        if self.sample is not None:
            found = _drawn_cells(found, self.sample)
        if by:
            found = _sorted(found, by, is_falling=str(self.sort).startswith("-"))
        if self.repeats:
            found = _repeated_cells(run, found, self.repeats)
            wanted.append(_LAST_BITS)
        columns = _columns(found, ["torque_error", *wanted])
        listed = [
            {
                **{name: _value(cell, name) for name in columns},
                "reason": cell["reason"],
                "command": rerun_command(run.path, cell["id"]),
            }
            for cell in found
        ]
        return CellsResult(str(run.path), len(run.plan.cells), columns, listed)

    def exit_code(self, result: "CellsResult") -> int:
        return OK if result.cells else NOTHING


class CellsCommand(Cells):
    is_long: bool = option(
        "Reason and reproduce command of each cell.", default=False, flags="--long"
    )
    limit: int | None = option("Only the first N; a screen by default.", default=None, least=1)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_json, terminal_lines, terminal_output

        result = self.run()
        if as_json:
            print_json(result)
        else:
            screen = None if self.is_long else terminal_lines()
            click.echo(terminal_output(result.text(self.limit or screen, long=self.is_long)))
        return self.exit_code(result)


cells = python_function(Cells, "cells")


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
        from sysid_bench.metrics import METRICS
        from sysid_bench.reporting.writers import markdown_text, table_line

        shown = self.cells[:limit]
        sides = ["---:" if name in METRICS or name == "repeat" else "---" for name in self.columns]
        rows = ([_cell_text(cell[name]) for name in self.columns] for cell in shown)
        parts = ["\n".join(map(table_line, [self.columns, sides, *rows]))]
        for cell in shown if long else ():
            reason = f"{cell['status']}: {cell['reason']}" if cell["reason"] else cell["status"]
            parts.append(f"{cell['id']} {markdown_text(str(reason))}\n    {cell['command']}")
        hidden = len(self.cells) - len(shown)
        more = f", {hidden} of them not shown" if hidden else ""
        if _LAST_BITS in self.columns:
            edges = sum(cell[_LAST_BITS] != SAME for cell in self.cells)
            more += f"; {edges} give another answer where the last bits of their data differ"
        return "\n\n".join([*parts, f"{len(self.cells)} of {self.planned} cells{more}"])


def _cell_text(value: Any) -> str:
    from sysid_bench.reporting.selection import label
    from sysid_bench.reporting.writers import markdown_text

    if isinstance(value, float):
        return value_text(value)
    return "-" if value is None else markdown_text(label(value))


def _value(cell: Mapping[str, Any], name: str) -> Any:
    """Label of a cell, else field of its row."""
    return cell["labels"].get(name, cell.get(name))


def _selected_cells(
    run: "RunFolder", select: str | None, known: Collection[str]
) -> list[dict[str, Any]]:
    """Rows of the planned cells that meet the condition, with their fields and `labels`; a cell
    without a row is `OPEN`."""
    from sysid_bench.harness.cell import fields
    from sysid_bench.harness.suite.expression import Expression

    rows = run.rows().rows
    condition = None if select is None else Expression.parse(select, known)
    open_row = {"status": OPEN, "reason": "has not run yet"}
    merged = (
        {**open_row, **rows.get(cell.id, {}), **fields(cell), "labels": cell.first_fields}
        for cell in run.plan.cells
    )
    return [cell for cell in merged if condition is None or condition.holds(cell)]


def _drawn_cells(cells: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    # The smallest hashes: the same cells on every machine, whatever else is selected.
    every = (cell["id"] for cell in cells)
    order = sorted(every, key=lambda one: hashlib.sha256(one.encode()).digest())
    drawn = {*order[:count]}
    return [cell for cell in cells if cell["id"] in drawn]


def _repeated_cells(
    run: "RunFolder", cells: Sequence[dict[str, Any]], repeats: int
) -> list[dict[str, Any]]:
    """Cells that have run, with what other last bits of their data change."""
    ids = [cell["id"] for cell in cells if cell["status"] != OPEN]
    texts = repeat_difference(run, ids, repeats)
    found = [{**cell, _LAST_BITS: texts[cell["id"]]} for cell in cells if cell["id"] in texts]
    # Stable: cells with another answer first, each part in the order asked for.
    return sorted(found, key=lambda cell: cell[_LAST_BITS] == SAME)


def _sorted(cells: Sequence[dict[str, Any]], by: str, *, is_falling: bool) -> list[dict[str, Any]]:
    """Cells by the value of a field; numbers before texts, cells without a value last."""
    from sysid_bench.reporting.selection import label

    def key(cell: Mapping[str, Any]) -> tuple[bool, float, str]:
        value = _value(cell, by)
        is_number = isinstance(value, (int, float))
        return not is_number, float(value) if is_number else 0.0, "" if is_number else label(value)

    valued = [cell for cell in cells if _value(cell, by) is not None]
    without = [cell for cell in cells if _value(cell, by) is None]
    return sorted(valued, key=key, reverse=is_falling) + without


def _columns(cells: Sequence[Mapping[str, Any]], asked: Sequence[str]) -> list[str]:
    """Columns of a list: labels in which these cells differ, then what was asked for."""
    from sysid_bench.reporting.selection import label

    def follows(name: str, other: str) -> bool:
        """True where each value of another label has one value of this one: it adds nothing."""
        pairs = {(label(c["labels"].get(other, "")), label(c["labels"][name])) for c in cells}
        return len(pairs) == len({first for first, _ in pairs})

    differing: list[str] = []
    for name in (*LABELS, "repeat"):
        if not any(follows(name, other) for other in ("", *differing)):
            differing.append(name)
    return list(dict.fromkeys(["id", *differing, "status", *asked]))


# --- Cells on data whose last bits differ -------------------------------------------------------


def repeat_difference(run: "RunFolder", ids: Sequence[str], repeats: int) -> dict[str, str]:
    """Return the effect of the data's last bits on the answers of cells, by id: "same", or the
    different ends and the range of the torque error. Each cell is executed again, on its data and
    on `repeats` copies with other last bits, in a worker process with the limits of the suite."""
    from sysid_bench.harness.run import job_of
    from sysid_bench.harness.work.worker_call import CallWorker, WorkerError
    from sysid_bench.units import quantity

    wanted, found = set(ids), dict[str, str]()
    groups = dict[str, list["Cell"]]()  # cells of one experiment share its data
    for cell in run.plan.cells:
        if cell.id in wanted:
            groups.setdefault(cell.experiment, []).append(cell)
    limits = run.suite.run
    # The time of a cell holds for each repeat, and for the data as they are.
    timeout, memory = quantity(limits.timeout, "s") * (repeats + 1), quantity(limits.memory, "B")
    target = "sysid_bench.experiments.cell_data:repeat_cells"
    for group in groups.values():
        job = job_of(group, run.suite, run.suite.robots_folder)
        with CallWorker(timeout * len(group), memory) as worker:
            try:
                answers = worker.call(target, {"job": job, "repeats": repeats}, "last bits")
            except WorkerError as error:
                found |= {cell.id: str(error) for cell in group}
            else:
                found |= {cell: difference_text(rows) for cell, rows in answers.items()}
    return found


def difference_text(answers: Sequence["Row"]) -> str:
    """Return the differences between answers to one problem beyond the condition of the data times
    the size of the changes, and beyond the tolerance of solvers; "same" without any."""
    ends = {name: _different(answers, name) for name in _ENDS}
    parts = [f"{name} {_either(values)}" for name, values in ends.items() if len(values) > 1]
    errors = [row["torque_error"] for row in answers if row.get("torque_error") is not None]
    limit = max(_explained_change(answers), _TOLERANCE * max(errors, default=0.0))
    if errors and max(errors) - min(errors) > limit:
        parts.append(f"torque_error {min(errors):.7g} to {max(errors):.7g}")
    counts = _different(answers, "iterations")
    if parts and len(counts) > 1:
        parts.append(f"iterations {_either(counts)}")
    return "; ".join(parts) or SAME


def _explained_change(answers: Sequence["Row"]) -> float:
    """Change of the torque error, relative to the torque, that the condition explains."""
    from sysid_bench.experiments.cell_data import SIZE

    # A relative change of the data grows at most by the condition number in the answer.
    condition = max((row.get("condition") or 1.0 for row in answers), default=1.0)
    return max(_LEAST, _GROWTH * condition * SIZE)


def _different(answers: Iterable[Mapping[str, Any]], name: str) -> list[Any]:
    return list(dict.fromkeys(row.get(name) for row in answers))


def _either(values: Iterable[Any]) -> str:
    return " or ".join(map(str, values))
