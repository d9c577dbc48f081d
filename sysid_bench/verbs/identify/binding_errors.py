"""Costs of the constraints that bind in a feasible fit: its error with and without each."""

from collections.abc import Iterator, Mapping, Sequence
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
    theta = identify(LMI(), problem).theta
    if theta is None:
        return None
    judged = list(tests.values()) or [problem]
    with_all = _error(theta, problem, judged)
    costs = []
    for name, members in _left_out(problem, binding_constraints(problem, theta)):
        free = identify(LMI(), problem_without(problem, *members)).theta
        error = _error(free, problem, judged)
        if error is not None and with_all is not None:
            costs.append({"constraint": name, "cost": with_all - error})
    return sorted(costs, key=lambda cost: (cost["constraint"] in GROUPS, -cost["cost"]))


def _error(theta: Array | None, problem: Problem, judged: list[Problem]) -> float | None:
    """Share of the RMS torque that parameters leave; None without them or without torque."""
    if theta is None:
        return None
    return RowErrors(judged, problem.base.K @ theta).torque_error


def _left_out(problem: Problem, binding: Sequence[str]) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield names and members of the constraints to leave out: groups, then one by one."""
    bodies = {body.name for body in problem.bodies}
    of_bodies = [name for name in binding if name in bodies]
    of_terms = [name for name in binding if name not in bodies]
    groups = zip(GROUPS, (of_bodies, of_terms), strict=True)
    yield from ((name, members) for name, members in groups if len(members) > 1)
    yield from ((name, [name]) for name in binding[:TRIED])
