"""Conformance kits: the laws that every plug-in of a kind has to keep, with test cases to check
them on. `assert_conforms` and `check` serve estimators, `check_plugin_of` every kind."""

from sysid_bench.apps.conformance.estimator import TestProblem, assert_conforms, check
from sysid_bench.apps.conformance.findings import Finding, failed_checks
from sysid_bench.apps.conformance.plugin import KITS, check_plugin_of

__all__ = [
    "KITS",
    "Finding",
    "TestProblem",
    "assert_conforms",
    "check",
    "check_plugin_of",
    "failed_checks",
]
