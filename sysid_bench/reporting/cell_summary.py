"""Text of a cell's recording: settings, scores and parameters."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid_bench.metrics import METRICS
from sysid_bench.reporting.markdown import escape
from sysid_bench.reporting.selection import label
from sysid_bench.types import CellData

_IDENTITY = ("robot", "payload", "task", "excitation", "simulation", "noise", "estimator")


def summary(data: CellData, complaints: Sequence[str] = ()) -> str:
    """Markdown of the settings, scores and base parameters of a cell, and of `complaints`."""
    row = data.row
    known = [(name, row[name]) for name in _IDENTITY if row.get(name) is not None]
    shown = [metric for metric in METRICS.values() if metric.shown and metric.name != "seconds"]
    scores = [(m.heading, row[m.name]) for m in shown if row.get(m.name) is not None]
    status = [("status", row.get("status", "unknown")), ("reason", row.get("reason"))]
    known += [(name, value) for name, value in status if value]
    parts = [f"# {escape(label(row.get('robot', 'Cell')))}", _table(("", ""), known)]
    if scores:
        parts.append(_table(("score", "value"), scores))
    parts += _parameters(data)
    parts += [f"Not drawn: {escape(text)}" for text in complaints]
    return "\n\n".join(parts) + "\n"


def _parameters(data: CellData) -> list[str]:
    """The base parameters that were estimated, each with its standard deviation where known."""
    estimate, base = data.estimate, data.base
    if estimate is None or estimate.beta is None or base is None:
        return []
    std = [None] * base.rank
    if estimate.covariance is not None:
        std = list(np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0)))
    rows = [
        (name, beta, "" if sigma is None else sigma)
        for name, beta, sigma in zip(base.names, estimate.beta, std, strict=True)
    ]
    title = f"## Base parameters: {base.rank} of {len(base.parameters)} unknowns"
    return [title, _table(("pivot of the combination (SI)", "estimate", "std"), rows)]


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [head, ["---"] * len(head), *([escape(_short(cell)) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _short(value: Any) -> str:
    if isinstance(value, (float, np.floating)):
        return f"{value:.4g}"
    return label(value)
