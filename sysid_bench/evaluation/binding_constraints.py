"""Costs of the constraints of a feasible fit: those that bind, left out one by one."""

from collections.abc import Mapping
from typing import Any, Final

from sysid_bench.evaluation.torque_errors import RowErrors
from sysid_bench.identification.estimators.feasible import LMI
from sysid_bench.identification.feasibility.lmi_fit import binding_constraints, problem_without
from sysid_bench.identification.identify import identify
from sysid_bench.types import Array, Problem

TRIED: Final = 24
"""Most constraints that are left out one by one."""

GROUPS: Final = ("all bodies", "all joint terms")
"""Constraints that are left out together, too."""


def binding_errors(problem: Problem, tests: Mapping[str, Problem]) -> list[dict[str, Any]] | None:
    """Return [{constraint, cost}] of the constraints that bind in the `lmi` fit of a problem, the
    most costly first, then of all bodies and of all joint terms together where several bind; None
    where `lmi` finds no bodies. Springs are not constrained.

    `cost`: error with all constraints minus that without this one, on the tests (share of the RMS
    torque; without tests that of training). A negative cost means that the constraint improves
    the prediction.
    """
    judged = list(tests.values()) or [problem]

    def error_of(theta: Array | None) -> float | None:
        """Share of the RMS torque that is left; None without parameters or without torque."""
        if theta is None:
            return None
        return RowErrors(judged, problem.base.K @ theta).torque_error

    theta = identify(LMI(), problem).theta
    if theta is None:
        return None
    with_all, costs = error_of(theta), []
    for name, members in _left_out(problem, theta):
        error = error_of(identify(LMI(), problem_without(problem, *members)).theta)
        if error is not None and with_all is not None:
            costs.append({"constraint": name, "cost": with_all - error})
    return sorted(costs, key=lambda cost: (cost["constraint"] in GROUPS, -cost["cost"]))


def _left_out(problem: Problem, theta: Array) -> list[tuple[str, list[str]]]:
    """Name and members of what is left out: groups of several constraints, then each one."""
    binding = binding_constraints(problem, theta)
    bodies = {body.name for body in problem.bodies}
    of_bodies = [name for name in binding if name in bodies]
    of_terms = [name for name in binding if name not in bodies]
    # Left out singly a constraint may cost nothing where a neighbour holds the same base parameter.
    groups = zip(GROUPS, (of_bodies, of_terms), strict=True)
    left_out = [(name, members) for name, members in groups if len(members) > 1]
    return left_out + [(name, [name]) for name in binding[:TRIED]]
