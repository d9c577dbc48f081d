"""For tests of one's own estimators: `from sysid_bench.pytest_plugin import assert_conforms`."""

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sysid_bench.conformance import TestProblem


def assert_conforms(estimator: Any) -> None:
    """Runs an estimator, or what a name or {use = ...} of a suite stands for, through its laws.

    Raises AssertionError that lists every broken law, UsageError where nothing has that name.
    """
    from sysid_bench import conformance
    from sysid_bench.naming import build

    if isinstance(estimator, (str, Mapping)):
        estimator = build("estimator", estimator)
    conformance.assert_conforms(estimator, _worlds(not hasattr(estimator, "solve")))


@cache
def _worlds(simulating: bool) -> "list[TestProblem]":
    from sysid_bench.verbs.check_plugin import problems_of_kind

    return problems_of_kind(simulating)
