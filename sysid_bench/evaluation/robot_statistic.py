"""Statistics over robots: comparison of methods, and verdicts on published claims.

The unit of replication is the robot (or what a claim counts in its place). Medians have intervals
of order statistics; below `ROBOTS.fewest` robots there is none, and a claim is open. Each figure of
a method depends on its own errors and those of the reference alone, so that entering another method
changes none of them, the correction over all verdicts apart; each figure of a claim on the rows
that the claim selects alone. Shares have the interval of a binomial, at least 95 %: a bootstrap of
equal shares has no width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Final, Literal

import numpy as np

from sysid_bench.evaluation.intervals import (
    ROBOTS,
    median_interval,
    median_ranks,
    only_level,
    percentile_interval,
    share_interval,
    tails,
)
from sysid_bench.types import Array

UNDECIDED: Final = "undecided"


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
        ends = map(float, np.exp(median_interval(logs) or ()))
        return cls(float(np.exp(np.median(logs))), *ends)


def rank_test_p(values: Array) -> float:
    """Return the exact two-sided p of Wilcoxon's signed-rank test (1945) for values (n,).

    Zeros are dropped and ties get their mean rank; the distribution is that of all 2^n signs of
    these ranks, which is exact with ties as well (Pratt and Gibbons 1981, chapter 3).
    """
    values = values[values != 0]
    _, index, count = np.unique(np.abs(values), return_inverse=True, return_counts=True)
    # Twice the mean ranks are whole numbers: the sums can be counted.
    last = np.cumsum(count)
    doubled = (2 * last - count + 1)[index]
    chances = np.ones(1)
    for rank in doubled:
        without, taken = np.zeros((2, len(chances) + rank))
        without[: len(chances)], taken[rank:] = chances, chances
        # Each rank has either sign with one half: the distribution of the sum by convolution, rank
        # by rank.
        chances = 0.5 * (without + taken)
    seen = int(doubled[values > 0].sum())
    return float(min(1.0, 2.0 * min(chances[: seen + 1].sum(), chances[seen:].sum())))


def least_p(differing: int) -> float:
    """Return the smallest p of `rank_test_p` for this many values that are not zero: all of one
    sign, 2 of 2^n. The test drops zeros, so that robots without a difference are not counted."""
    return 2.0 ** (1 - differing) if differing > 0 else 1.0


def equivalence_p(values: Array, margin: float) -> float:
    """Return the two-sided p of the sign test that the median of log ratios (n,) lies outside of
    +-ln(1 + margin): twice the larger of both one-sided p (Schuirmann 1987). It is at most 1 -
    level where the interval of order statistics lies within the margin; like `rank_test_p` it is
    not below 2 of 2^n."""
    limit, n = np.log1p(margin), len(values)
    within = min(int((values >= -limit).sum()), int((values <= limit).sum()))
    return min(1.0, 2.0 * float(sum(comb(n, k) for k in range(within, n + 1))) / 2.0**n)


def holm(p: Array) -> Array:
    """Return the p-values (k,) or (k, h) corrected by Holm's step-down method (1979).

    Of the h hypotheses in a line at most one is true, as "no difference" and "a difference beyond
    the margin": each step counts the lines that have one left (Shaffer 1986), so that testing both
    costs no more than testing one.
    """
    flat = p.ravel()
    order = np.argsort(flat, kind="stable")
    lines = order // (flat.size // max(len(p), 1) or 1)
    # A line is done where its last hypothesis was rejected, one step before.
    last = {line: step for step, line in enumerate(lines.tolist())}
    done = np.bincount(np.array(sorted(last.values()), dtype=int) + 1, minlength=len(flat) + 1)
    left = len(p) - np.cumsum(done)[: len(flat)]
    out = np.empty(flat.size)
    # A later p is never smaller.
    out[order] = np.minimum(np.maximum.accumulate(flat[order] * left), 1.0)
    return out.reshape(p.shape)


def robots_needed(verdicts: int) -> int:
    """Return how many robots that all agree decide one of this many verdicts, corrected together:
    the fewest whose smallest p, times the verdicts, is below 1 - level."""
    at_most, robots = 2.0 * tails()[0], ROBOTS.fewest
    while least_p(robots) * verdicts > at_most or median_ranks(robots) is None:
        robots += 1
    return robots


def verdict(logs: Array, margin: float, p: float, p_equivalent: float) -> str:
    """Return "better", "worse", "equivalent" or "undecided" for mean log ratios (robots,).

    `p` and `p_equivalent` are those of `rank_test_p` and `equivalence_p`, corrected over all
    verdicts that are printed together. Better or worse: p is significant, the interval lies on one
    side of zero, and the median is beyond the margin; a significant difference of a few percent is
    neither that nor equivalent.
    """
    ends, at_most = median_interval(logs), 2.0 * tails()[0]
    if ends is None:
        return UNDECIDED
    if p_equivalent <= at_most:
        return "equivalent"
    if p > at_most or ends[0] <= 0.0 <= ends[1] or abs(np.median(logs)) <= np.log1p(margin):
        return UNDECIDED
    return "better" if ends[1] < 0.0 else "worse"


def win_rates(values: Array) -> Array:
    """Return the fraction (methods, methods) of cases in which the row's method beats the column's,
    for errors (cases, methods) with inf for a failure and NaN where there is no row; of the cases
    in which both have a row. Ties and pairs of failures count half; NaN where there is no case."""
    both = ~np.isnan(values)
    # inf < inf is false: two failures are a tie.
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


def rank_interval(logs: Array) -> tuple[Array, Array, Array]:
    """Return ranks (methods,), 1 for the smallest median of logs (robots, methods), and the ends of
    their interval from robots drawn again; NaN for too few robots. NaN in `logs` is a
    robot without a row of the method."""
    rank = _ranks(np.nanmedian(logs, axis=0))
    if len(logs) < ROBOTS.fewest:
        return rank, np.full(len(rank), np.nan), np.full(len(rank), np.nan)
    draws = ROBOTS.indices(len(logs))
    medians = []
    for values in (column[draws] for column in logs.T):
        missing = np.isnan(values).all(axis=1, keepdims=True)
        # A draw without any robot of a method keeps no median of it: last in that draw.
        median = np.nanmedian if np.isnan(values).any() else np.median
        medians.append(median(np.where(missing, np.inf, values), axis=1))
    drawn = _ranks(np.column_stack(medians))
    return rank, *percentile_interval(drawn)


def _ranks(medians: Array) -> Array:
    """Ranks from 1 along the last axis; equal values share the lowest of theirs."""
    below = medians[..., None, :] < medians[..., :, None]
    return np.asarray(1.0 + below.sum(axis=-1))


Direction = Literal["at most", "at least", "within"]
Verdict = Literal["holds", "fails", "open", "not testable", "withdrawn"]

MOST_LOST: Final = 0.1
"""Share of cells without an answer above which a claim on the others cannot hold."""


SPREAD: Final = 1e-12
"""Range of coverages up to which they are the same number: nothing is known of their scatter."""


@dataclass(frozen=True)
class ClaimFigure:
    """Value and 95 % interval over `count` robots; no interval for too few of them, or where
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


_STEPS: Final = 14
"""Halvings of the level at which an interval stops to decide: p to 6e-5."""


def claim_p(figure_of: Callable[[], ClaimFigure], threshold: ClaimInterval) -> float:
    """Return the p-value of a verdict: the smallest 1 - level at which the interval that
    `figure_of` makes still lies on one side of the threshold; 1 where none does."""
    low, high = 0.0, 1.0  # 1 - level, at which it is open and decided
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        with only_level(1.0 - middle):
            is_open = claim_verdict(figure_of(), threshold) == "open"
        low, high = (middle, high) if is_open else (low, middle)
    return high


def benjamini_hochberg(p: Array) -> Array:
    """Return the p-values (k,) corrected so that of the rejected ones a share of at most the level
    is false in the mean (Benjamini and Hochberg 1995)."""
    order = np.argsort(p)[::-1]
    ranks = np.arange(len(p), 0, -1)
    out = np.empty(len(p))
    # From the largest on, a smaller p is never corrected to a larger one.
    out[order] = np.minimum.accumulate(np.minimum(p[order] * len(p) / np.maximum(ranks, 1), 1.0))
    return out


MOST_UNITS: Final = 400
"""Units up to which it is looked for how many of them let a claim hold."""


def units_needed(statistic: str, threshold: ClaimInterval) -> int | None:
    """Return the fewest units with which a claim can hold, all of them agreeing; None where no
    number does, as for a share of 1, which no interval reaches."""
    for count in range(1, MOST_UNITS + 1):
        if count < ROBOTS.fewest or median_ranks(count) is None:
            continue
        if statistic != "share":
            return count
        # All or none for a limit; for two, any number of hits between.
        hits = range(count + 1) if np.isfinite([threshold.low, threshold.high]).all() else ()
        ends = (share_interval(k, count) for k in {0, count, *hits})
        if any(threshold.low <= low and high <= threshold.high for low, high in ends):
            return count
    return None


def by_robot(robots: Array, values: Array) -> Array:
    """Return the mean (robots,) of the values (n,) of each robot, in the order of the names; NaN
    are left out, and robots that have nothing else."""
    means = mean_by_robot(robots, values, np.unique(robots).tolist())
    return np.asarray(means[~np.isnan(means)])


def median_figure(values: Array) -> ClaimFigure:
    """Return the median of values (robots,), one or more, with the interval of order statistics."""
    low, high = median_interval(values) or (None, None)
    return ClaimFigure(float(np.median(values)), low, high, len(values))


def ratio_figure(logs: Array) -> ClaimFigure:
    """Return exp(median of log ratios (robots,)), with the interval of order statistics."""
    figure = RatioFigure.of(logs)
    return ClaimFigure(float(np.exp(np.median(logs))), figure.low, figure.high, len(logs))


def share_figure(values: Array) -> ClaimFigure:
    """Return the mean of shares (robots,) in [0, 1], with the interval of Clopper and Pearson
    (1934) for their sum, at least 95 %: robots that all agree leave 1 - 0.025^(1 / robots) open.
    Shares of several cells vary less than hits, and it is conservative."""
    ends = share_interval(float(values.sum()), len(values))
    low, high = (None, None) if len(values) < ROBOTS.fewest else ends
    return ClaimFigure(float(values.mean()), low, high, len(values))


def mean_figure(values: Array) -> ClaimFigure:
    """Return the mean of coverages (robots,), with the percentile interval of the bootstrap; none
    where all are the same number."""
    figure = ClaimFigure(float(values.mean()), None, None, len(values))
    if len(values) < ROBOTS.fewest:
        return figure
    if np.ptp(values) <= SPREAD:
        return figure.without_interval("no spread")
    means = values[ROBOTS.indices(len(values))].mean(axis=1)
    low, high = map(float, percentile_interval(means))
    return replace(figure, low=low, high=high)


def rank_figure(logs: Array) -> ClaimFigure:
    """Return the rank of the first method, 1 for the smallest median, of logs (robots, methods)."""
    rank, *ends = (float(part[0]) for part in rank_interval(logs))
    low, high = (None if np.isnan(end) else end for end in ends)
    return ClaimFigure(rank, low, high, len(logs))
