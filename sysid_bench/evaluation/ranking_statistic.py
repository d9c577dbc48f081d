"""Statistical comparison of methods over robots and motions.

Inference is over robots and motions; repeats with other noise seeds say something about one robot
only. Values are errors (smaller is better); NaN is a failure, and is worse than any number.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Final, Literal

import numpy as np
import scipy

from sysid_bench.types import Array

DRAWS: Final = 2000
"""Bootstrap resamples."""


def interquartile_mean(values: Array, axis: int = 0) -> Array:
    """Return the interquartile mean along `axis`: the mean of the middle half of the values, with
    fractional weights at its edges (Agarwal et al. 2021)."""
    ordered = np.sort(np.moveaxis(np.asarray(values, dtype=float), axis, 0), axis=0)
    n = len(ordered)
    edges = np.arange(n + 1) / n
    weight = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0.0, None)
    used = weight > 0
    return np.asarray(np.tensordot(weight[used] / weight.sum(), ordered[used], axes=1))


def robot_interval(
    values: Array,
    statistic: Callable[[Array], Array] = interquartile_mean,
    level: float = 0.95,
    draws: int = DRAWS,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Return (low, high), the percentile bootstrap interval of `statistic` at confidence `level`.

    values (robots, motions, ...) are resampled hierarchically: robots with replacement, then
    motions of each drawn robot. `statistic` maps (robots * motions, ...) to (...).
    """
    rng = np.random.default_rng(seed)
    robots, motions = values.shape[0], values.shape[1]
    resampled = []
    # Motions of one robot are correlated: resampling cells alike would make intervals too short.
    for _ in range(draws):
        chosen = rng.integers(robots, size=(robots, 1))
        within = rng.integers(motions, size=(robots, motions))
        drawn = values[chosen, within]
        resampled.append(statistic(drawn.reshape(-1, *values.shape[2:])))
    low, high = np.quantile(resampled, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return low, high


def wilcoxon_holm(values: Array) -> Array:
    """Return the p-values (methods, methods) of Wilcoxon's signed-rank test between all pairs of
    methods, for values (robots, methods).

    Holm's correction is over all pairs; the diagonal is one. Ranks are of |log(value ratio)|, so
    that robots of different size have equal weight.
    """
    count, p = values.shape[1], np.eye(values.shape[1])
    pairs = list(combinations(range(count), 2))
    for (i, j), corrected in zip(pairs, _corrected_p_values(values, pairs), strict=True):
        p[i, j] = p[j, i] = corrected
    return p


def wilcoxon_holm_reference(values: Array, reference: int) -> Array:
    """Return the p-values (methods,) of the same test against one method, `reference`.

    Holm's correction is over these comparisons alone, so that fewer robots suffice; the reference
    has to be chosen before the results are known. Its own p-value is one.
    """
    others = [i for i in range(values.shape[1]) if i != reference]
    p = np.ones(values.shape[1])
    p[others] = _corrected_p_values(values, [(i, reference) for i in others])
    return p


def _corrected_p_values(values: Array, pairs: Sequence[tuple[int, int]]) -> Array:
    # Rounding makes equal ratios exact ties.
    logs = np.round(np.log(failed_last(values)), 9)
    first, second = np.array(pairs, dtype=int).reshape(-1, 2).T
    differences = logs[:, first] - logs[:, second]
    p = np.ones(len(pairs))
    different = differences.any(axis=0)
    if different.any():
        # By default SciPy resolves ties by permutations: minutes for all pairs of 24 methods.
        method: Literal["exact", "approx"] = "exact" if len(values) <= 50 else "approx"
        p[different] = scipy.stats.wilcoxon(differences[:, different], axis=0, method=method).pvalue
    return holm(p)


def holm(p: Array) -> Array:
    """Return the p-values (k,) corrected for k comparisons by Holm's step-down method (1979)."""
    order = np.argsort(p)
    # The smallest p is multiplied by k, the next by k - 1, ...; a later one is never smaller.
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty(len(p))
    out[order] = np.minimum(stepped, 1.0)
    return out


def win_rates(values: Array) -> Array:
    """Return the fraction (methods, methods) of cases in which the row's method beats the column's,
    for values (cases, methods); ties and pairs of failures count half."""
    ranked = np.where(np.isnan(values), np.inf, values)  # inf == inf: two failures are a tie
    better = ranked[:, :, None] < ranked[:, None, :]
    same = ranked[:, :, None] == ranked[:, None, :]
    return np.asarray((better + 0.5 * same).mean(axis=0))


def performance_profile(values: Array, ratios: Array) -> Array:
    """Return the performance profile (ratios, methods): the fraction of cases in which a method is
    within each ratio of the best of that case, for values (cases, methods).

    Dolan and More (2002). A failure is within no ratio.
    """
    failed = np.isnan(values)
    best = np.where(failed, np.inf, values).min(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        # A best of exactly zero is within every ratio of itself, although 0 / 0 is not a number.
        relative = np.where(values == best, 1.0, values / best)
    within = (relative <= np.asarray(ratios)[:, None, None]) & ~failed
    return np.asarray(within.mean(axis=1))


def failed_last(values: Array) -> Array:
    """Return values (cases, methods) with each failure replaced by ten times the worst of its
    case."""
    none = np.isnan(values).all(axis=1, keepdims=True)
    worst = np.nanmax(np.where(none, 1.0, values), axis=1)
    return np.where(np.isnan(values), 10.0 * worst[:, None], values)
