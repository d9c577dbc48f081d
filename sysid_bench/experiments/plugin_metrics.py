"""Metrics of a suite's [[metric]] entries, computed at the end of a cell."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from sysid_bench.evaluation.score import base_parameters
from sysid_bench.metrics import metric_fields
from sysid_bench.plugin_names import build
from sysid_bench.types import MetricInput, Row


def plugin_metrics(argument: Mapping[str, Any], cell: MetricInput) -> Row:
    """Row fields of `argument["metrics"]` ({name, spec} each, see harness/job.py); empty values
    where the estimator gave no estimate."""
    entries = argument.get("metrics", ())
    if base_parameters(cell.estimate) is None:
        return {entry["name"]: None for entry in entries}
    makers = {entry["name"]: partial(build, "metric", entry["spec"]) for entry in entries}
    return metric_fields(makers, cell)
