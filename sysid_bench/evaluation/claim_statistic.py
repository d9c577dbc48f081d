"""Verdict on a published claim from values: figures over robots, their interval, a threshold.

Robots (or what a claim counts in their place) are drawn again; below FEWEST of them there is no
interval, and the claim is open. Shares have the interval of a binomial, at least 95 %: a bootstrap
of equal shares has no width. Each figure depends on the rows that the claim selects alone.
"""

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from sysid_bench.evaluation.ranking_statistic import (
    FEWEST,
    RatioFigure,
    mean_by_robot,
    median_interval,
    random_robots,
    rank_interval,
)
from sysid_bench.evaluation.repeat_statistic import share_interval
from sysid_bench.types import Array

Direction = Literal["at most", "at least", "within"]
Verdict = Literal["holds", "fails", "open", "not testable"]

MOST_LOST: Final = 0.1
"""Share of cells without an answer above which a claim on the others cannot hold."""


SPREAD: Final = 1e-12
"""Range of coverages up to which they are the same number: nothing is known of their scatter."""


@dataclass(frozen=True)
class ClaimFigure:
    """Value and 95 % interval over `count` robots; no interval for fewer than FEWEST, or where
    `reason` says why there is none."""

    value: float
    low: float | None
    high: float | None
    count: int
    reason: str = ""

    def without_interval(self, reason: str) -> "ClaimFigure":
        """The same value, about which nothing can be decided."""
        return replace(self, low=None, high=None, reason=reason)


@dataclass(frozen=True)
class ClaimInterval:
    """Values that a claim allows: from `low` to `high`, infinite where there is no limit."""

    low: float
    high: float

    @classmethod
    def of(cls, direction: Direction, limits: tuple[float, ...]) -> "ClaimInterval":
        """The threshold of a direction: one limit, or two for "within"."""
        if direction == "within":
            return cls(*limits)
        return cls(-np.inf, limits[0]) if direction == "at most" else cls(limits[0], np.inf)


def claim_verdict(figure: ClaimFigure, threshold: ClaimInterval) -> Verdict:
    """Return "holds" where the whole interval is allowed, "fails" where none of it is, "open" where
    it straddles a limit or there is no interval."""
    if figure.low is None or figure.high is None:
        return "open"
    if threshold.low <= figure.low and figure.high <= threshold.high:
        return "holds"
    return "fails" if figure.high < threshold.low or threshold.high < figure.low else "open"


def by_robot(robots: Array, values: Array) -> Array:
    """Return the mean (robots,) of the values (n,) of each robot, in the order of the names; NaN
    are left out, and robots that have nothing else."""
    means = mean_by_robot(robots, values, np.unique(robots).tolist())
    return np.asarray(means[~np.isnan(means)])


def median_figure(values: Array) -> ClaimFigure:
    """Return the median of values (robots,), one or more, with the interval of the bootstrap."""
    low, high = median_interval(values) or (None, None)
    return ClaimFigure(float(np.median(values)), low, high, len(values))


def ratio_figure(logs: Array) -> ClaimFigure:
    """Return exp(median of log ratios (robots,)), with the interval of the bootstrap."""
    figure = RatioFigure.of(logs)
    return ClaimFigure(float(np.exp(np.median(logs))), figure.low, figure.high, len(logs))


def share_figure(values: Array) -> ClaimFigure:
    """Return the mean of shares (robots,) in [0, 1], with the interval of Clopper and Pearson
    (1934) for their sum, at least 95 %: robots that all agree leave 1 - 0.025^(1 / robots) open.
    Shares of several cells vary less than hits, and it is conservative."""
    ends = share_interval(float(values.sum()), len(values))
    low, high = (None, None) if len(values) < FEWEST else ends
    return ClaimFigure(float(values.mean()), low, high, len(values))


def mean_figure(values: Array) -> ClaimFigure:
    """Return the mean of coverages (robots,), with the percentile interval of the bootstrap; none
    where all are the same number."""
    figure = ClaimFigure(float(values.mean()), None, None, len(values))
    if len(values) < FEWEST:
        return figure
    if np.ptp(values) <= SPREAD:
        return figure.without_interval("no spread")
    means = values[random_robots(len(values))].mean(axis=1)
    low, high = map(float, np.quantile(means, [0.025, 0.975]))
    return replace(figure, low=low, high=high)


def rank_figure(logs: Array) -> ClaimFigure:
    """Return the rank of the first method, 1 for the smallest median, of logs (robots, methods)."""
    rank, low, high = (float(part[0]) for part in rank_interval(logs))
    if len(logs) < FEWEST:
        return ClaimFigure(rank, None, None, len(logs))
    return ClaimFigure(rank, low, high, len(logs))
