"""Argument of `execute` for one experiment: JSON values, so that any worker can run it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sysid_bench.harness.cell import Cell, fields
from sysid_bench.harness.suite.expression import Expression
from sysid_bench.harness.suite.model import Suite
from sysid_bench.naming import resolve_files
from sysid_bench.units import quantity


def job_of(cells: Sequence[Cell], suite: Suite, robots_dir: Path | None) -> dict[str, Any]:
    """Return the argument for these cells, all of one experiment.

    Plug-in files and robots are found from the suite's folder; `labels` begin every row.
    """
    by_estimator = ("id", "estimator")
    return {
        "experiment": cells[0].spec.to_json(),
        "seed": suite.seed,
        "estimators": [
            {
                **resolve_files(cell.estimator, suite.folder),
                "cell": cell.id,
                "label": cell.labels["estimator"],
            }
            for cell in cells
        ],
        "metrics": [
            {"name": entry.metric.name, "spec": resolve_files(entry.spec, suite.folder)}
            for entry in suite.metric
        ],
        "papers": {cell.id: _papers(cell, suite) for cell in cells} if suite.paper else {},
        "labels": {
            key: value for key, value in cells[0].first_fields.items() if key not in by_estimator
        },
        "crosscheck": {
            "tolerance": quantity(suite.crosscheck.tolerance, "1"),
            "on_fail": suite.crosscheck.on_fail,
        },
        "folder": str(suite.folder),
        "robots_dir": None if robots_dir is None else str(robots_dir.resolve()),
    }


def _papers(cell: Cell, suite: Suite) -> list[dict[str, Any]]:
    """[[paper]] entries that may show a cell; a condition on scores is open until it has run."""
    flat = fields(cell)
    found = []
    for entry in suite.paper:
        wanted = None if entry.select is None else Expression.parse(entry.select)
        if wanted is None or not wanted.fields <= set(flat) or wanted.holds(flat):
            found.append({"name": entry.name, "show": entry.show, "test": entry.test})
    return found
