"""Judgement of one row: its status, its cross-check, and what its baseline says."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sysid_bench.harness.cell import Cell
from sysid_bench.harness.comparison.baseline import Baseline
from sysid_bench.harness.comparison.run_difference import find_difference
from sysid_bench.harness.comparison.run_values import cell_values, settings_key, true_values
from sysid_bench.verbs.runs import change_table as listing

_SHOWN = ("status", "reason", "crosscheck", "rank", "gap", "condition", "torque_error", "seconds")


def cell_text(cell: Cell, row: Mapping[str, Any], baseline: Baseline | None, folder: str) -> str:
    """What is wrong with a row, with the row and the command that computes it again; "" for
    nothing. Without its cell in a baseline a row has to be ok, and its regressor the one of
    Pinocchio."""
    if baseline is None or cell.id not in baseline.run.cells:
        wrong = _failures(row)
    else:
        wrong = _changes(cell, row, baseline)
    if not wrong:
        return ""
    facts = [f"{name:<14}{row[name]}" for name in _SHOWN if row.get(name) not in (None, "")]
    return "\n\n".join(
        [*wrong, "\n".join(facts), f"reproduce: {listing.cell_command(folder, cell.id)}"]
    )


def _failures(row: Mapping[str, Any]) -> list[str]:
    """Why a row is not ok, or its regressor not that of Pinocchio."""
    if row["status"] == "ok" and row.get("crosscheck") != "failed":
        return []
    return [str(row.get("reason") or "the cross-check failed")]


def _changes(cell: Cell, row: Mapping[str, Any], baseline: Baseline) -> list[str]:
    """Tables of what is worse than the baseline."""
    known = baseline.run
    first = cell.first_fields
    values = cell_values(first, dict(row), known.axes, known.metrics)
    table = row.get("parameters_table") or ()
    truth = true_values(table)
    parameters = {settings_key(first, table): truth} if truth else {}
    now = replace(known, cells={cell.id: values}, parameters=parameters)
    changes = find_difference(known, now, baseline.tolerances, partial=True)
    if not changes.is_failed:
        return []
    worse = listing.largest_first(changes.failed_cells)
    return listing.tables_text(changes, "Worse than the baseline", worse)
