"""Conformance kit of metrics: what a row may rely on, checked on two finished cells."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Final

from sysid_bench.apps.conformance.estimator import experiment_spec
from sysid_bench.apps.conformance.findings import Finding, data_hash
from sysid_bench.errors import reason_of
from sysid_bench.evaluation.score import score
from sysid_bench.experiments.loaded_robot import loaded_robot
from sysid_bench.experiments.simulated.prepare import prepare_simulated
from sysid_bench.identification.estimators.linear import WLS
from sysid_bench.identification.identify import identify
from sysid_bench.metrics import REASONS, metric_fields, metric_of_plugin
from sysid_bench.types import Metric, MetricInput

EXPERIMENTS: Final[tuple[Mapping[str, Any], ...]] = (
    {"robot": "random:7", "noise": {"tau_relative": 0.01}},
    {"robot": "ur5", "task": "payload", "payload": "box-2kg", "noise": {"tau_relative": 0.01}},
)
"""A whole robot and a payload, noisy, each with a held-out motion."""

DISTURBANCE: Final = 0.3
"""Share by which every base parameter is changed, far beyond any estimate's error."""


def check_metric_plugin(metric: Metric) -> list[Finding]:
    """Findings of a metric: one for each violated law, or a single one that it passes."""
    law, case = "keeps the laws of a metric", "two experiments"
    broken = check_metric(metric, metric_cells())
    return [Finding(law, case, False, one) for one in broken] or [Finding(law, case, True)]


@cache
def metric_cells() -> tuple[MetricInput, ...]:
    """The experiments, identified by weighted least squares and scored."""
    cells = []
    for changes in EXPERIMENTS:
        # Held-out motions differ in kind, or a metric of prediction would see the training again.
        spec = experiment_spec({"held_out": ({"use": "ptp"},), **changes})
        prepared = prepare_simulated(spec, loaded_robot(spec.robot, spec.payload, None, None))
        estimate = identify(WLS(), prepared.problem, prepared.experiment)
        scores = score(estimate, prepared.problem, prepared.held_out, prepared.source.truth)
        cells.append(MetricInput(estimate, prepared.problem, prepared.held_out, scores))
    return tuple(cells)


def check_metric(metric: Metric, cells: Sequence[MetricInput]) -> list[str]:
    """Broken laws, one sentence each; [] for a sound metric.

    The record is complete; every value is a finite number or None, some value is a number; the
    same cell gives the same value; the input stays as it was. A ranked metric is not negative, and
    a disturbed estimate is not better than the given one.
    """
    try:
        metric_of_plugin(metric)
    except Exception as error:
        return [reason_of(error)]
    findings = [finding for cell in cells for finding in _on_cell(metric, cell)]
    # A metric without any value would keep all laws.
    if not findings and all(_value(metric, cell)[0] is None for cell in cells):
        findings.append("No cell has a value.")
    return list(dict.fromkeys(findings))


def _on_cell(metric: Metric, cell: MetricInput) -> Iterator[str]:
    before = _data_hash(cell)
    value, reason = _value(metric, cell)
    if reason:
        yield f"A cell has no value: {reason}."
        return
    if _value(metric, cell)[0] != value:
        yield "The same cell gives two values."
    if _data_hash(cell) != before:
        yield "The input has changed."
    if not metric.ranked or value is None:
        return
    if value < 0:
        yield f"A ranked metric is not negative; a cell has {value:g}."
    # The sign of a metric is easily inverted: more error has to be a larger value.
    worse, _ = _value(metric, _disturbed(cell))
    if worse is not None and worse < value:
        yield f"Parameters that are off by {DISTURBANCE:.0%} look better: {worse:g} < {value:g}."


def _value(metric: Metric, cell: MetricInput) -> tuple[float | None, str]:
    fields = metric_fields({metric.name: lambda: metric}, cell)
    return fields[metric.name], fields.get(REASONS, {}).get(metric.name, "")


def _data_hash(cell: MetricInput) -> str:
    """Hash of the estimate and the reduced data of a cell."""
    factors = [problem.factors for problem in (cell.problem, *cell.held_out.values())]
    return data_hash((cell.estimate, factors))


def _disturbed(cell: MetricInput) -> MetricInput:
    """The cell with every parameter off by the same share, theta along with beta = K theta."""
    estimate = cell.estimate
    beta, theta = (
        None if x is None else (1 + DISTURBANCE) * x for x in (estimate.beta, estimate.theta)
    )
    return replace(cell, estimate=replace(estimate, beta=beta, theta=theta))
