"""Intervals: their level, the methods that make them, what is drawn again, and how many it needs.

=====================  ==========================  ================================================
method                 from                        used by
=====================  ==========================  ================================================
Student's t            a covariance and its        parameters of an estimate (`StandardError`),
                       degrees of freedom          torques of a further motion
Student's t of a new   mean and scatter of n       one of n values against the others
value                  values                      (`left_out_held`), actuators of a new file
jackknife              parts left out, each once   motions, blocks of time, masses of payloads
chi-squared            loss over its smallest      delay of commands
order statistics       the k-th smallest and       medians over robots: rankings, claims, ratios of
                       largest of n values         two runs; coverage is exact (`median_ranks`)
percentile bootstrap   robots drawn again          ranks, mean coverages (`ROBOTS`), twins and
                                                   transfer (`ROBOT_TYPES`)
percentile bootstrap   repeats drawn again         bias, spread, efficiency (`REPEATS`), statistics
                                                   of the entries of a table (`TABLE_REPEATS`)
Clopper and Pearson    hits of n                   shares: claims, worst coverage
=====================  ==========================  ================================================
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from math import comb
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.types import Array

LEVEL: Final = 0.95
"""Confidence level of intervals where neither a suite nor the command line states another."""

_stated: ContextVar[float | None] = ContextVar("level", default=None)


def confidence_level() -> float:
    """Return the level of all intervals: that of `at_level`, else LEVEL."""
    return _stated.get() or LEVEL


def is_stated() -> bool:
    """True where `at_level` holds, as under --confidence or in a suite with its own level."""
    return _stated.get() is not None


@contextmanager
def at_level(level: float | None) -> Iterator[None]:
    """Make all intervals at a level, unless an outer one is stated already, as by --confidence;
    None: as without it. Raises UsageError for a level that is not between 0 and 1."""
    if level is not None and not 0.0 < level < 1.0:
        raise UsageError(f"A confidence level lies between 0 and 1, as 0.95; got {level:g}.")
    token = _stated.set(_stated.get() or level)
    try:
        yield
    finally:
        _stated.reset(token)


@contextmanager
def only_level(level: float) -> Iterator[None]:
    """Make all intervals at a level, whatever is stated: to find the highest that still decides."""
    token = _stated.set(level)
    try:
        yield
    finally:
        _stated.reset(token)


def level_text() -> str:
    """Return the level as titles print it: "95 %"."""
    return f"{100 * confidence_level():.10g} %"


def with_level(text: str) -> str:
    """Return a text that names the usual level with the present one."""
    return text.replace(f"{100 * LEVEL:g} %", level_text())


def tails(level: float | None = None) -> tuple[float, float]:
    """Return the probabilities below the low and below the high end of a two-sided interval, of the
    present level unless one is given."""
    level = confidence_level() if level is None else level
    # 0.5 - 0.5 * 0.95 is 0.025 + 2e-17: rounded, all methods have the same two probabilities.
    return round(0.5 - 0.5 * level, 12), round(0.5 + 0.5 * level, 12)


def coverage_factor(freedom: float, level: float | None = None) -> float:
    """Return the two-sided quantile of Student's distribution: half of the length of an interval of
    a confidence level, in standard deviations. Infinite `freedom`: of the normal distribution."""
    from scipy.special import stdtrit  # loads longer than a table takes

    # stdtrit is not defined for infinity; at 1e9 Student's distribution is the normal one.
    return float(stdtrit(min(freedom, 1e9), tails(level)[1]))


@dataclass(frozen=True, eq=False)
class StandardError:
    """Covariance (r, r) of an estimate, and the degrees of freedom it was estimated with."""

    covariance: Array
    freedom: float = np.inf

    @property
    def std(self) -> Array:
        """Standard deviations (r,)."""
        return np.sqrt(np.diag(self.covariance))

    def margins(self, level: float | None = None) -> Array:
        """Return half of the length (r,) of the confidence interval."""
        return coverage_factor(self.freedom, level) * self.std

    def interval(self, beta: Array, level: float | None = None) -> tuple[Array, Array]:
        """Return the confidence interval (low, high), (r,) each, by Student's distribution."""
        half_width = self.margins(level)
        return beta - half_width, beta + half_width


def jackknife(values: Array, centre: Array) -> StandardError:
    """Return the jackknife covariance (M - 1) / M sum_m (v_m - c)(v_m - c)' of estimates `values`
    (M, r) with one of M parts left out each, about `centre` (r,) (Tukey 1958)."""
    # Estimates that share most of their data differ little: the factor is not 1 / (M - 1).
    moved = np.sqrt((len(values) - 1) / len(values)) * (values - centre)
    return StandardError(moved.T @ moved, len(values) - 1)


def jackknife_std(values: Array) -> tuple[Array, int]:
    """Return the jackknife deviations (k,) of n estimates (n, k) about their mean, with one of n
    parts left out each, and their degrees of freedom."""
    n = len(values)
    spread = np.sum((values - values.mean(axis=0)) ** 2, axis=0)
    return np.sqrt((n - 1) / n * spread), n - 1


def likelihood_drop() -> float:
    """Return twice the loss of log-likelihood at the ends of the interval of one parameter: the
    quantile of chi-squared with one degree of freedom, 3.84 at 95 %."""
    # To two decimals, as kept rows were made with.
    return round(coverage_factor(np.inf) ** 2, 2)


def held(error: StandardError, beta: Array, targets: Array) -> Array:
    """Return the mask (r,) of the intervals that hold their target."""
    low, high = error.interval(beta)
    return np.asarray((low <= targets) & (targets <= high))


def interval_score(error: StandardError, beta: Array, targets: Array) -> Array:
    """Return the interval score (r,): width plus 2 / alpha times the distance of the target from
    the interval (Gneiting and Raftery 2007, equation 43); lower is better."""
    low, high = error.interval(beta)
    outside = np.maximum(low - targets, 0.0) + np.maximum(targets - high, 0.0)
    return np.asarray(high - low + 2.0 / (1.0 - confidence_level()) * outside)


def new_value_interval(values: Array, level: float | None = None) -> tuple[Array, Array]:
    """Return the ends (...) of the range that holds a further value with a probability `level`,
    from n values (n, ...): mean +- t s sqrt(1 + 1 / n), Student's t of n - 1 degrees of freedom."""
    n, mean = len(values), values.mean(axis=0)
    reach = coverage_factor(n - 1, level) * np.sqrt(1.0 + 1.0 / n) * values.std(axis=0, ddof=1)
    return mean - reach, mean + reach


def left_out_held(values: Array, share: float | None = None) -> Array:
    """Test (n, ...) whether each of n values lies in the range of the n - 1 others that holds a new
    one with a probability `share` (None: the level). NaN for fewer than three."""
    if len(values) < 3:
        return np.full(values.shape, np.nan)
    inside = np.empty(values.shape)
    for k, own in enumerate(values):
        low, high = new_value_interval(np.delete(values, k, axis=0), share)
        inside[k] = (low <= own) & (own <= high)
    return inside


def share_interval(hits: float, count: int) -> tuple[float, float]:
    """Return the interval of a share, `hits` of `count`, that holds it at least at the level
    (Clopper and Pearson 1934).

    It inverts the exact binomial test, which is conservative since counts are whole numbers. A sum
    of shares may take the place of whole hits, and makes it more so: the variance of each is at
    most that of a hit with the same mean.
    """
    from scipy.special import betaincinv

    below, above = tails()
    low = float(betaincinv(hits, count - hits + 1, below)) if hits > 0 else 0.0
    high = float(betaincinv(hits + 1, count - hits, above)) if hits < count else 1.0
    return low, high


@dataclass(frozen=True)
class Bootstrap:
    """Units that are drawn again with replacement, `draws` times with a seed of its own: the same
    draws in every figure, which depends on its own values alone. There is no interval for fewer
    than `fewest` of them."""

    unit: str
    draws: int
    seed: int
    fewest: int

    def indices(self, count: int) -> Array:
        """Return the indices (draws, count) of `count` units drawn again; read-only."""
        return _indices(self, count)

    def counts(self, count: int) -> Array:
        """Return how often each of `count` units is drawn, (draws, count): for statistics of sums,
        which need no copy of the values."""
        chances = np.full(count, 1 / count)
        return np.random.default_rng(self.seed).multinomial(count, chances, size=self.draws)


@cache
def _indices(bootstrap: Bootstrap, count: int) -> Array:
    size = (bootstrap.draws, count)
    drawn = np.random.default_rng(bootstrap.seed).integers(count, size=size)
    drawn.flags.writeable = False
    return drawn


# A bootstrap of fewer than six robots is shorter than it claims, and no p of the signed-rank test
# below 0.05 is possible (2^(1-5) = 0.063).
ROBOTS: Final = Bootstrap("robots", draws=10_000, seed=0, fewest=6)

# With fewer than 20 repeats the standard deviation itself is uncertain by more than 20 %.
REPEATS: Final = Bootstrap("repeats", draws=2000, seed=0, fewest=20)

# Robots of one type count as one unit: their errors are alike.
ROBOT_TYPES: Final = Bootstrap("types of robot", draws=2000, seed=0, fewest=5)

# Whole repeats: the cells of one repeat share their noise.
TABLE_REPEATS: Final = Bootstrap("repeats", draws=2000, seed=20240229, fewest=2)


def percentile_interval(drawn: Array) -> tuple[Array, Array]:
    """Return the ends (...) of the percentile interval of a statistic (draws, ...) of bootstrap
    draws."""
    low, high = np.quantile(drawn, tails(), axis=0)
    return low, high


def median_ranks(count: int) -> tuple[int, float] | None:
    """Return the largest k for which the interval from the k-th smallest to the k-th largest of
    `count` values holds the median of their population at the level, and how often it does;
    None where there is none, or too few robots.

    It misses the median where fewer than k values lie on one side of it: 2 P(B < k), B binomial
    with one half, whatever the distribution (Thompson 1936). With ties it holds it more often.
    """
    below, missed, found = tails()[0], 0.0, None
    for k in range(1, count // 2 + 1):
        missed += comb(count, k - 1) / 2**count
        if missed > below:
            break
        found = (k, 1.0 - 2.0 * missed)
    return found if count >= ROBOTS.fewest else None


def median_interval(values: Array) -> tuple[float, float] | None:
    """Return the interval of the median of values (robots,) from its order statistics; None for
    too few robots."""
    # The percentile bootstrap of a median covers 91 % instead of 95 % for 8 and 13 robots.
    if (found := median_ranks(len(values))) is None:
        return None
    ordered = np.sort(values)
    return float(ordered[found[0] - 1]), float(ordered[-found[0]])
