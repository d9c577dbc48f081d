"""Text of a cell's recording: settings, scores and parameters."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.markdown import markdown_text, table_line
from sysid_bench.reporting.selection import label
from sysid_bench.types import CellData, Estimate

_IDENTITY = (
    "robot", "payload", "task", "plant", "excitation", "simulation", "noise", "pipeline",
    "estimator",
)  # fmt: skip


def summary(data: CellData, complaints: Sequence[str] = ()) -> str:
    """Markdown of the settings, scores and base parameters of a cell, and of `complaints`."""
    parts = [
        f"# {markdown_text(label(data.row.get('robot', 'Cell')))}",
        _table(("", ""), _settings(data.row)),
        *_scores(data.row),
        *_parameters(data),
        *(f"Not drawn: {markdown_text(text)}" for text in complaints),
    ]
    return "\n\n".join(parts) + "\n"


def _settings(row: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Settings that identify a cell, its status and the reason of a failure or of the last step."""
    known = [(name, row[name]) for name in _IDENTITY if row.get(name) is not None]
    status = [("status", row.get("status", "unknown")), ("reason", row.get("reason"))]
    status.append(("stop", row.get("stop")))
    return known + [(name, value) for name, value in status if value]


def _scores(row: Mapping[str, Any]) -> Iterator[str]:
    values = [(m, row.get(m.name)) for m in METRICS.values() if m.shown and m.name != "seconds"]
    scores = [(metric.heading, value) for metric, value in values if value is not None]
    if scores:
        yield _table(("score", "value"), scores)


def _parameters(data: CellData) -> Iterator[str]:
    """The base parameters that were estimated, each with its standard deviation where known."""
    estimate, base = data.estimate, data.base
    if estimate is None or estimate.beta is None or base is None:
        return
    std = _standard_deviations(estimate, base.rank)
    yield f"## Base parameters: {base.rank} of {len(base.parameters)} unknowns"
    rows = list(zip(base.names, estimate.beta, std, strict=True))
    yield _table(("pivot of the combination (SI)", "estimate", "std"), rows)


def _standard_deviations(estimate: Estimate, rank: int) -> list[Any]:
    """Standard deviation of each base parameter, "" where the estimator gives no covariance."""
    if estimate.covariance is None:
        return [""] * rank
    # Rounding can make the variance of an exactly known parameter negative.
    return list(np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0)))


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    body = (map(_cell, row) for row in rows)
    return "\n".join(map(table_line, [head, ["---"] * len(head), *body]))


def _cell(value: Any) -> str:
    return markdown_text(
        f"{value:.4g}" if isinstance(value, (float, np.floating)) else label(value)
    )
