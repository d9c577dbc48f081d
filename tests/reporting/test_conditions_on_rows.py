"""Conditions of tables, rankings and macros may read what only the plan of a cell has."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from sysid_bench.commands.run_folder import row_selection
from sysid_bench.harness.plan import cells_of_suite
from sysid_bench.harness.stored_run import RunFolder
from sysid_bench.harness.suite.load_suite import parse_suite

SUITE = """
schema = 1
name = "noise"
[defaults]
noise = [{ tau = "0.5 %" }, { tau = "2 %" }, {}]
[[robot]]
use = "scara"
[[estimator]]
use = "ols"
"""


@pytest.mark.parametrize(
    ("condition", "kept"),
    [
        ('robot == "scara" and noise.tau == "0.5 %"', [True, False, False]),
        ("noise.tau > 0.01 and torque_error < 1", [False, True, False]),
        ('noise == "exact"', [False, False, True]),
    ],
)
def test_fields_of_the_plan_hold_for_rows(condition: str, kept: list[bool]) -> None:
    plan = cells_of_suite(parse_suite(SUITE))
    choose = row_selection(cast(RunFolder, SimpleNamespace(plan=plan)))
    rows: list[dict[str, Any]] = [{**c.first_fields, "torque_error": 0.5} for c in plan.cells]
    assert [choose(condition, row) for row in rows] == kept
