"""Conformance kit of metrics: the laws of `evaluation.metric_checks` on two small experiments."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Final

from sysid_bench.apps.conformance.estimator_problems import experiment_spec
from sysid_bench.apps.conformance.findings import Finding
from sysid_bench.evaluation.metric_checks import check_metric
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.identify import identify
from sysid_bench.types import Metric, MetricInput

EXPERIMENTS: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5", "task": "payload", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""A whole robot and a payload, noisy, each with a held-out motion."""


def check_metric_plugin(metric: Metric) -> list[Finding]:
    """Findings of a metric: one for each violated law, or a single one that it passes."""
    broken = check_metric(metric, metric_cells())
    if not broken:
        return [Finding("keeps the laws of a metric", "two experiments", True)]
    return [Finding("keeps the laws of a metric", "two experiments", False, b) for b in broken]


@cache
def metric_cells() -> tuple[MetricInput, ...]:
    """The experiments, identified by weighted least squares and scored."""
    return tuple(_cell(changes) for changes in EXPERIMENTS)


def _cell(changes: Mapping[str, Any]) -> MetricInput:
    # Held-out motions differ in kind, or a metric of prediction would see the training again.
    spec = experiment_spec({"held_out": ({"use": "ptp"},), **changes})
    prepared = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, None, None))
    estimate = identify(WLS(), prepared.problem, prepared.experiment)
    scores = score(estimate, prepared.problem, prepared.held_out, prepared.source.truth)
    return MetricInput(estimate, prepared.problem, prepared.held_out, scores)
