"""Conformance kits: the laws that every plug-in of a kind has to keep, with test cases to check
them on. `assert_conforms` and `check` serve estimators, `check_plugin_of` every kind."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from sysid_bench.apps.conformance.effect import check_effect
from sysid_bench.apps.conformance.error_checks import check_model_error, check_sensor_error
from sysid_bench.apps.conformance.estimator import (
    TestProblem,
    assert_conforms,
    check,
    estimator_cases,
    estimator_problems,
)
from sysid_bench.apps.conformance.findings import Finding, failed_checks
from sysid_bench.apps.conformance.log_reader_checks import check_log_reader
from sysid_bench.apps.conformance.metric import check_metric_plugin
from sysid_bench.apps.conformance.motion_checks import check_excitation, check_simulation
from sysid_bench.apps.conformance.pipeline import check_pipeline
from sysid_bench.apps.conformance.task_checks import check_task
from sysid_bench.errors import UsageError, unknown_name

__all__ = [
    "KITS",
    "Finding",
    "TestProblem",
    "assert_conforms",
    "check",
    "check_plugin_of",
    "failed_checks",
]


def check_estimator(estimator: Any, robots_dir: Path | None = None) -> list[Finding]:
    """Findings of an estimator on the test problems of its kind: `solve` or `fit`."""
    simulating = not hasattr(estimator, "solve")
    if robots_dir is None:
        return check(estimator, estimator_cases(simulating))
    return check(estimator, estimator_problems(simulating, robots_dir))


KITS: Final[Mapping[str, Callable[..., list[Finding]]]] = MappingProxyType(
    {
        "estimator": check_estimator,
        "excitation": check_excitation,
        "plant": check_effect,
        "simulation": check_simulation,
        "pipeline": check_pipeline,
        "metric": check_metric_plugin,
        "log_reader": check_log_reader,
        "task": check_task,
        "model_error": check_model_error,
        "sensor_error": check_sensor_error,
    }
)
"""Kit by kind: (plug-in, its test cases where they are not those of the kit) -> findings."""

EXECUTOR: Final = "executor"
"""Kind whose kit is that of the harness: sysid_bench.apps.conformance.executor_checks."""


def check_kind(kind: str) -> str:
    """The kind of plug-in that is meant: "log-reader" is "log_reader". Raises UsageError for a kind
    without a kit."""
    known = kind.replace("-", "_")
    if known not in (*KITS, EXECUTOR):
        raise unknown_name("conformance kit", kind, (*KITS, EXECUTOR))
    return known


def check_plugin_of(
    kind: str, plugin: Any, robots_dir: Path | None = None, file: Path | None = None
) -> list[Finding]:
    """Findings of a plug-in object of a kind of `KITS`; raises UsageError for another kind.

    `robots_dir`: folder with the robots of an estimator's test problems; `file`: recorded file for
    a log reader, None: files that the kit writes.
    """
    kind = check_kind(kind)
    if file is not None and kind != "log_reader":
        raise UsageError(
            f"A recorded file is read by log readers, not by a plug-in of kind {kind}."
        )
    data = {"estimator": robots_dir, "log_reader": file}.get(kind)
    return KITS[kind](plugin) if data is None else KITS[kind](plugin, data)
