"""Statistical comparison of methods with a reference, over robots.

The unit of replication is the robot. Each figure of a method depends on its own errors and those of
the reference alone, so that entering another method changes none of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from sysid_bench.types import Array

DRAWS: Final = 10_000
"""Bootstrap resamples."""

SEED: Final = 0
"""Seed of the bootstrap."""

FEWEST: Final = 6
"""Robots below which there is no interval: a bootstrap of fewer values is shorter than it claims,
and no p below 0.05 is possible (2^(1-5) = 0.063)."""


def mean_by_robot(robots: Sequence[str] | Array, values: Array, names: Sequence[str]) -> Array:
    """Return the mean (names,) of the values (n,) of each robot of `names`, where `robots` (n,) are
    those of the values; NaN are left out, and a robot without another value has NaN."""
    labels, known = np.asarray(robots), ~np.isnan(values)
    chosen = [values[known & (labels == name)] for name in names]
    return np.array([part.mean() if len(part) else np.nan for part in chosen])


@dataclass(frozen=True)
class RatioFigure:
    """exp of the median over robots, and its 95 % interval where there are enough of them."""

    value: float | None
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, logs: Array) -> "RatioFigure":
        """Return the figure of mean log ratios (robots,); without a value for zero robots."""
        if len(logs) == 0:
            return cls(None)
        ends = median_interval(logs)
        value = float(np.exp(np.median(logs)))
        return cls(value) if ends is None else cls(value, *map(float, np.exp(ends)))


@cache
def random_robots(robots: int) -> Array:
    """Return indices (DRAWS, robots) of robots drawn with replacement: the same for every method,
    so that methods are compared on the same draws."""
    drawn = np.random.default_rng(SEED).integers(robots, size=(DRAWS, robots))
    drawn.flags.writeable = False
    return drawn


def median_interval(logs: Array, level: float = 0.95) -> tuple[float, float] | None:
    """Return the percentile bootstrap interval of the median of values (robots,) at confidence
    `level`; None for fewer than FEWEST robots."""
    if len(logs) < FEWEST:
        return None
    medians = np.median(logs[random_robots(len(logs))], axis=1)
    low, high = np.quantile(medians, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return float(low), float(high)


def rank_test_p(values: Array) -> float:
    """Return the exact two-sided p of Wilcoxon's signed-rank test (1945) for values (n,).

    Zeros are dropped and ties get their mean rank; the distribution is that of all 2^n signs of
    these ranks, which is exact with ties as well (Pratt and Gibbons 1981, chapter 3).
    """
    values = values[values != 0]
    if len(values) == 0:
        return 1.0
    _, index, count = np.unique(np.abs(values), return_inverse=True, return_counts=True)
    # Twice the mean ranks are whole numbers: the sums can be counted.
    last = np.cumsum(count)
    doubled = (2 * last - count + 1)[index]
    chances = np.ones(1)
    for rank in doubled:
        without, taken = np.zeros((2, len(chances) + rank))
        without[: len(chances)], taken[rank:] = chances, chances
        chances = 0.5 * (without + taken)
    seen = int(doubled[values > 0].sum())
    return float(min(1.0, 2.0 * min(chances[: seen + 1].sum(), chances[seen:].sum())))


def least_p(differing: int) -> float:
    """Return the smallest p of `rank_test_p` for this many values that are not zero: all of one
    sign, 2 of 2^n. The test drops zeros, so that robots without a difference are not counted."""
    return 2.0 ** (1 - differing) if differing > 0 else 1.0


def holm(p: Array) -> Array:
    """Return the p-values (k,) corrected for k comparisons by Holm's step-down method (1979)."""
    order = np.argsort(p)
    # The smallest p is multiplied by k, the next by k - 1, ...; a later one is never smaller.
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty(len(p))
    out[order] = np.minimum(stepped, 1.0)
    return out


def verdict(low: float, high: float, margin: float) -> str:
    """Return "better", "worse", "equivalent" or "undecided" for the interval of a log ratio.

    Equivalent: the interval lies within ln(1 + margin) of zero. Better or worse: it lies on one
    side of zero, and reaches beyond the margin.
    """
    limit = np.log1p(margin)
    if -limit <= low and high <= limit:
        return "equivalent"
    if high < 0.0:
        return "better"
    return "worse" if low > 0.0 else "undecided"


def win_rates(values: Array) -> Array:
    """Return the fraction (methods, methods) of cases in which the row's method beats the column's,
    for errors (cases, methods) with inf for a failure and NaN where there is no row; of the cases
    in which both have a row. Ties and pairs of failures count half; NaN where there is no case."""
    both = ~np.isnan(values)
    better = (values[:, :, None] < values[:, None, :]).sum(axis=0)
    same = (values[:, :, None] == values[:, None, :]).sum(axis=0)
    cases = (both[:, :, None] & both[:, None, :]).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray((better + 0.5 * same) / cases)


def ratio_profile(ratios: Array, limits: Array) -> Array:
    """Return the profile (limits,): the share of ratios (cases,) up to each limit. NaN, a failure,
    is within no limit; no case gives zeros."""
    within = ratios[None, :] <= np.asarray(limits)[:, None]
    return np.asarray(within.sum(axis=1) / max(len(ratios), 1))


def rank_interval(logs: Array, level: float = 0.95) -> tuple[Array, Array, Array]:
    """Return ranks (methods,), 1 for the smallest median of logs (robots, methods), and the ends of
    their interval from robots drawn again; NaN for fewer than FEWEST robots. NaN in `logs` is a
    robot without a row of the method."""
    rank = _ranks(np.nanmedian(logs, axis=0))
    if len(logs) < FEWEST:
        return rank, np.full(len(rank), np.nan), np.full(len(rank), np.nan)
    draws = random_robots(len(logs))
    # A draw without any robot of a method keeps no median of it: last in that draw.
    medians = [_medians(column[draws]) for column in logs.T]
    drawn = _ranks(np.column_stack(medians))
    low, high = np.quantile(drawn, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return rank, low, high


def _medians(values: Array) -> Array:
    """Medians (draws,) of values (draws, robots) without NaN; inf where all are NaN."""
    if not np.isnan(values).any():
        return np.asarray(np.median(values, axis=1))
    missing = np.isnan(values).all(axis=1, keepdims=True)
    return np.asarray(np.nanmedian(np.where(missing, np.inf, values), axis=1))


def _ranks(medians: Array) -> Array:
    """Ranks from 1 along the last axis; equal values share the lowest of theirs."""
    below = medians[..., None, :] < medians[..., :, None]
    return np.asarray(1.0 + below.sum(axis=-1))
