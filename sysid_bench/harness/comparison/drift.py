"""Common drift of a metric: cells that each keep their tolerance, and move together."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from sysid_bench.harness.comparison.run_values import RunValues, Tolerance

SMALLEST: Final = 1e-2
"""Share of the logarithm of a tolerance from which on a drift counts: below it are the digits of a
baseline and what other libraries change."""
LEVEL: Final = 1e-3
"""Probability below which a mean is no chance: a gate looks at a few metrics at each commit."""
_DIGITS: Final = 1e-6
"""Scatter (of a logarithm) that groups have at least: values are stored with seven digits."""


@dataclass(frozen=True)
class Drift:
    """Mean factor of a metric over `cells` within their tolerance, in `groups` of one experiment
    each; `p`: that of Student's t for the mean logarithm of the groups."""

    metric: str
    cells: tuple[str, ...]
    groups: int
    factor: float
    p: float
    verdict: Literal["worse", "better"]


def find_drift(
    before: RunValues, after: RunValues, cells: Collection[str], tolerances: Mapping[str, Tolerance]
) -> tuple[Drift, ...]:
    """Return the drifts of the metrics that are compared by a factor and have a better direction,
    over those of `cells` that both runs have; values beyond their tolerance are changes of their
    own, which must not hide what the others do."""
    found = []
    for name, tolerance in tolerances.items():
        better = before.metrics[name].better
        if tolerance.kind != "ratio" or better is None or tolerance.size == 1.0:
            continue
        logs = _logs(name, before, after, cells, tolerance)
        means = _group_means(before, logs)
        if len(means) < 2:
            continue
        mean, p = float(np.mean(means)), _two_sided_p(means)
        if abs(mean) >= SMALLEST * math.log(tolerance.size) and p <= LEVEL:
            worse = 1.0 if better == "lower" else -1.0
            verdict: Literal["worse", "better"] = "worse" if np.sign(mean) == worse else "better"
            found.append(Drift(name, tuple(logs), len(means), math.exp(mean), p, verdict))
    return tuple(found)


def _logs(
    name: str, before: RunValues, after: RunValues, cells: Collection[str], tolerance: Tolerance
) -> dict[str, float]:
    """Logarithm of after over before by cell, of values above rounding and within tolerance."""
    old, new = [*before.metrics].index(name), [*after.metrics].index(name)
    logs = {}
    for cell in cells:
        was, now = before.cells[cell].values[old], after.cells[cell].values[new]
        # A ratio of roundings says nothing; nor does one across zero.
        if was is None or now is None or not min(was, now) > tolerance.floor:
            continue
        if tolerance.holds(was, now):
            logs[cell] = math.log(now / was)
    return logs


def _group_means(run: RunValues, logs: Mapping[str, float]) -> list[float]:
    """Means of the cells of one experiment, which share their data and move together for that
    reason alone; single cells where there are fewer than three experiments."""
    groups: dict[tuple[str, ...], list[float]] = {}
    for cell, log in logs.items():
        values = run.cells[cell]
        labels = zip(run.axes, values.labels, strict=False)  # a label may hold the separator
        key = (values.robot, *(label for axis, label in labels if axis != "estimator"))
        groups.setdefault(key, []).append(log)
    if len(groups) < 3:
        return [*logs.values()]
    return [float(np.mean(values)) for values in groups.values()]


def _two_sided_p(values: list[float]) -> float:
    """Two-sided p of Student's t-test of a zero mean."""
    from scipy.stats import t

    error = max(float(np.std(values, ddof=1)), _DIGITS) / math.sqrt(len(values))
    return float(2.0 * t.sf(abs(np.mean(values)) / error, len(values) - 1))
