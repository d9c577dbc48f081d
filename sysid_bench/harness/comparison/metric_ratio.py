"""Ratio of a metric between two runs, over robots."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.evaluation.intervals import median_interval
from sysid_bench.evaluation.robot_statistic import (
    RatioFigure,
    least_p,
    mean_by_robot,
    rank_test_p,
    verdict,
)
from sysid_bench.harness.comparison.run_values import RunValues
from sysid_bench.harness.comparison.tolerance import Tolerance, tolerance_of
from sysid_bench.types import Metric

MARGIN: Final = 0.1
"""Equivalence margin: ratios within a factor of 1.1 are equal in practice."""
_DIGITS: Final = 1e-6


@dataclass(frozen=True)
class MetricRatio:
    """A metric after over before: the median over `robots` of the mean log ratio of their cells,
    as `ratio`, with its 95 % interval (None for fewer than six robots).

    `lower` and `higher` count robots; `p` is that of Wilcoxon's signed-rank test, never below
    `smallest_p` with this many that differ. `zeros`: cells left out, since a value is zero,
    rounding or not there. `verdict`: better, worse, equivalent, undecided; "" without an interval
    or direction.
    """

    metric: str
    robots: int
    cells: int
    zeros: int
    ratio: float | None
    low: float | None
    high: float | None
    lower: int
    higher: int
    p: float
    smallest_p: float
    verdict: str


def metric_ratio(before: RunValues, after: RunValues) -> tuple[MetricRatio, ...]:
    """Ratios of the metrics of both runs that are compared by a factor, over the cells that are ok
    in both."""
    ok_after = set(_ok_cells(after))
    return tuple(_ratios(before, after, filter(ok_after.__contains__, _ok_cells(before))))


def _ok_cells(run: RunValues) -> list[str]:
    return [name for name, cell in run.cells.items() if cell.is_ok]


def _ratios(before: RunValues, after: RunValues, cells: Iterable[str]) -> Iterator[MetricRatio]:
    cells = list(cells)
    for name, metric in before.metrics.items():
        tolerance = tolerance_of(metric)
        if name in after.metrics and tolerance.kind == "ratio":
            yield _ratio(metric, tolerance, *_pairs(before, after, name, cells))


def _pairs(
    before: RunValues, after: RunValues, name: str, cells: Iterable[str]
) -> tuple[dict[str, list[tuple[float, float]]], int]:
    """Values before and after by robot, and the number of cells without both."""
    old, new = [*before.metrics].index(name), [*after.metrics].index(name)
    pairs: dict[str, list[tuple[float, float]]] = {}
    absent = 0
    for cell in cells:
        was, now = before.cells[cell].values[old], after.cells[cell].values[new]
        if was is None or now is None:
            absent += was is not now
        else:
            pairs.setdefault(before.cells[cell].robot, []).append((was, now))
    return pairs, absent


def _ratio(
    metric: Metric,
    tolerance: Tolerance,
    pairs: Mapping[str, list[tuple[float, float]]],
    absent: int,
) -> MetricRatio:
    logs = {robot: _logs(values, tolerance.floor) for robot, values in pairs.items()}
    means = mean_by_robot(
        [robot for robot, values in logs.items() for _ in values],
        np.array([value for values in logs.values() for value in values]),
        tuple(logs),
    )
    used = means[~np.isnan(means)]
    count, figure = sum(map(len, logs.values())), RatioFigure.of(used)
    return MetricRatio(
        metric=metric.name,
        robots=len(used),
        cells=count,
        zeros=absent + sum(map(len, pairs.values())) - count,
        ratio=figure.value,
        low=figure.low,
        high=figure.high,
        lower=int((used < 0).sum()),
        higher=int((used > 0).sum()),
        p=rank_test_p(used),
        smallest_p=least_p(int(np.count_nonzero(used))),
        verdict=_verdict(metric, median_interval(used)),
    )


def _logs(values: list[tuple[float, float]], floor: float) -> list[float]:
    """Log ratios of the pairs above rounding: a ratio of two roundings says nothing. Those within
    the digits of a baseline are zero."""
    pairs = (pair for pair in values if min(pair) > max(floor, 0.0))
    return [_log_ratio(was, now) for was, now in pairs]


def _log_ratio(was: float, now: float) -> float:
    log = float(np.log(now / was))
    return 0.0 if abs(log) < _DIGITS else log


def _verdict(metric: Metric, interval: tuple[float, float] | None) -> str:
    if interval is None or metric.better is None:
        return ""
    low, high = interval if metric.better == "lower" else (-interval[1], -interval[0])
    return verdict(low, high, MARGIN)
