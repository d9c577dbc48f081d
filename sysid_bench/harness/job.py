"""Argument of `execute` for one experiment: JSON values, so that any worker can run it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sysid_bench.experiments.third_party import NO_PARTS, third_party_parts
from sysid_bench.harness.cell import Cell, fields
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.model import Suite
from sysid_bench.plugin_names import resolve_files
from sysid_bench.units import quantity


def job_of(
    cells: Sequence[Cell], suite: Suite, robots_dir: Path | None, has_code: bool = True
) -> dict[str, Any]:
    """Return the argument for these cells, all of one experiment.

    Plug-in files and robots are found from the suite's folder; `labels` begin every row. `has_code`
    False: no plug-in of the suite is third-party, and none is looked for.
    """
    argument: dict[str, Any] = {
        "experiment": cells[0].spec.to_json(),
        "seed": suite.seed,
        "estimators": [_estimator(cell, suite) for cell in cells],
        "metrics": [
            {"name": entry.metric.name, "spec": resolve_files(entry.spec, suite.folder)}
            for entry in suite.metric
        ],
        "papers": {cell.id: _papers(cell, suite) for cell in cells} if suite.paper else {},
        "labels": _shared_fields(cells[0]),
        "crosscheck": {
            "tolerance": quantity(suite.crosscheck.tolerance, "1"),
            "on_fail": suite.crosscheck.on_fail,
        },
        "folder": str(suite.folder),
        "robots_dir": None if robots_dir is None else str(robots_dir.resolve()),
    }
    code = third_party_parts(argument) if has_code else NO_PARTS
    return argument | {"third_party": dict(code)}


def _estimator(cell: Cell, suite: Suite) -> dict[str, Any]:
    names = {"cell": cell.id, "label": cell.labels["estimator"]}
    return {**resolve_files(cell.estimator, suite.folder), **names}


def _shared_fields(cell: Cell) -> dict[str, Any]:
    """First fields of the rows of all cells of an experiment."""
    by_estimator = ("id", "estimator")
    return {key: value for key, value in cell.first_fields.items() if key not in by_estimator}


def _papers(cell: Cell, suite: Suite) -> list[dict[str, Any]]:
    """[[paper]] entries that may show a cell."""
    flat = fields(cell)
    return [
        {"name": entry.name, "show": entry.show, "test": entry.test}
        for entry in suite.paper
        if entry.select is None or _may_hold(Expression.parse(entry.select), flat)
    ]


def _may_hold(condition: Expression, flat: dict[str, Any]) -> bool:
    """True where a condition holds, or is on scores: it is open until the cell has run."""
    return not condition.fields <= set(flat) or condition.holds(flat)
