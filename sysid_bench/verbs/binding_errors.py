"""Costs of the constraints that bind in a feasible fit: its error with and without each."""

from collections.abc import Mapping
from typing import Any, Final

from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.identification.estimators.lmi import LMI
from sysid_bench.identification.feasibility.binding import binding_constraints, problem_without
from sysid_bench.identification.identify import identify
from sysid_bench.types import Problem

TRIED: Final = 24
"""Most constraints that are left out one by one."""


def binding_errors(problem: Problem, tests: Mapping[str, Problem]) -> list[dict[str, Any]] | None:
    """Return [{constraint, cost}] of the constraints that bind in the `lmi` fit of a problem, the
    most costly first; None where there is no such fit.

    `cost`: error with all constraints minus that without this one, on the tests (share of the RMS
    torque; without tests that of training). A negative cost means that the constraint improves
    the prediction.
    """
    theta = identify(LMI(), problem).theta
    if theta is None:
        return None
    judged = list(tests.values()) or [problem]
    with_all = RowErrors(judged, problem.base.K @ theta).torque_error
    costs = []
    for name in binding_constraints(problem, theta)[:TRIED]:
        free = identify(LMI(), problem_without(problem, name)).theta
        error = None if free is None else RowErrors(judged, problem.base.K @ free).torque_error
        if error is not None and with_all is not None:
            costs.append({"constraint": name, "cost": with_all - error})
    return sorted(costs, key=lambda cost: -cost["cost"])
