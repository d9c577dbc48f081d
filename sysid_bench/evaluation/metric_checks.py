"""Checks of a user's own metric on finished cells: what a row may rely on."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import starmap
from typing import Final

import numpy as np

from sysid_bench.errors import reason_of
from sysid_bench.metrics import REASONS, metric_fields, metric_of_plugin
from sysid_bench.types import Array, Metric, MetricInput

DISTURBANCE: Final = 0.3
"""Share by which every base parameter is changed, far beyond any estimate's error."""


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
    if not findings and all(_value(metric, cell)[0] is None for cell in cells):
        findings.append("No cell has a value.")
    return list(dict.fromkeys(findings))


def _on_cell(metric: Metric, cell: MetricInput) -> Iterator[str]:
    before = [array.copy() for array in _arrays(cell)]
    value, reason = _value(metric, cell)
    if reason:
        yield f"A cell has no value: {reason}."
        return
    if _value(metric, cell)[0] != value:
        yield "The same cell gives two values."
    if not all(starmap(np.array_equal, zip(before, _arrays(cell), strict=True))):
        yield "The input has changed."
    if metric.ranked and value is not None:
        yield from _on_ranked(metric, cell, value)


def _on_ranked(metric: Metric, cell: MetricInput, value: float) -> Iterator[str]:
    """Broken laws of a metric by which methods are ranked, smaller being better."""
    if value < 0:
        yield f"A ranked metric is not negative; a cell has {value:g}."
    # The sign of a metric is easily inverted: more error has to be a larger value.
    worse, _ = _value(metric, _disturbed(cell))
    if worse is not None and worse < value:
        yield f"Parameters that are off by {DISTURBANCE:.0%} look better: {worse:g} < {value:g}."


def _value(metric: Metric, cell: MetricInput) -> tuple[float | None, str]:
    fields = metric_fields({metric.name: lambda: metric}, cell)
    return fields[metric.name], fields.get(REASONS, {}).get(metric.name, "")


def _arrays(cell: MetricInput) -> list[Array]:
    """The estimate and the reduced data of a cell."""
    problems = (cell.problem, *cell.held_out.values())
    arrays = [factor.R for problem in problems for factor in problem.factors]
    given = (cell.estimate.beta, cell.estimate.theta, cell.estimate.covariance)
    return [*arrays, *(array for array in given if array is not None)]


def _disturbed(cell: MetricInput) -> MetricInput:
    """The cell with every parameter off by the same share, theta along with beta = K theta."""
    beta, theta = cell.estimate.beta, cell.estimate.theta
    changed = replace(
        cell.estimate,
        beta=None if beta is None else (1 + DISTURBANCE) * beta,
        theta=None if theta is None else (1 + DISTURBANCE) * theta,
    )
    return replace(cell, estimate=changed)
