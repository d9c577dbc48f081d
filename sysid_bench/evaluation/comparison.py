"""Methods against each other: arrays in, numbers out.

Robots and motions are what a claim about methods is drawn over; noise seeds of one robot tell of
that robot alone. Values are errors, smaller is better; NaN is a failure, and loses to any number.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Final, Literal

import numpy as np

from sysid_bench.types import Array

DRAWS: Final = 2000


def interquartile_mean(values: Array, axis: int = 0) -> Array:
    """The mean of the middle half, its edges by their share (Agarwal et al. 2021)."""
    ordered = np.sort(np.moveaxis(np.asarray(values, dtype=float), axis, 0), axis=0)
    n = len(ordered)
    edges = np.arange(n + 1) / n
    weight = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0.0, None)
    used = weight > 0
    return np.asarray(np.tensordot(weight[used] / weight.sum(), ordered[used], axes=1))


def robot_bootstrap(
    values: Array,
    statistic: Callable[[Array], Array] = interquartile_mean,
    level: float = 0.95,
    draws: int = DRAWS,
    seed: int = 0,
) -> tuple[Array, Array]:
    """(low, high) of a statistic over robots and motions of values (robots, motions, ...): robots
    are drawn again, and motions of each drawn robot."""
    rng = np.random.default_rng(seed)
    robots, motions = values.shape[0], values.shape[1]
    found = []
    for _ in range(draws):
        chosen = rng.integers(robots, size=(robots, 1))
        within = rng.integers(motions, size=(robots, motions))
        drawn = values[chosen, within]
        found.append(statistic(drawn.reshape(-1, *values.shape[2:])))
    low, high = np.quantile(found, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return low, high


def wilcoxon_holm(values: Array) -> Array:
    """p (methods, methods) of Wilcoxon's signed-rank test between methods over robots, values
    (robots, methods), Holm's correction over all pairs; the diagonal is one.

    Signed ranks of the logarithm of the ratio: robots of different size count alike.
    """
    count, p = values.shape[1], np.eye(values.shape[1])
    pairs = list(combinations(range(count), 2))
    for (i, j), corrected in zip(pairs, _corrected_p_values(values, pairs), strict=True):
        p[i, j] = p[j, i] = corrected
    return p


def wilcoxon_holm_against(values: Array, reference: int) -> Array:
    """p (methods,) of the same test against one method that was named beforehand, Holm's correction
    over these comparisons alone: fewer questions need fewer robots. That method's own is one."""
    others = [i for i in range(values.shape[1]) if i != reference]
    p = np.ones(values.shape[1])
    p[others] = _corrected_p_values(values, [(i, reference) for i in others])
    return p


def _corrected_p_values(values: Array, pairs: Sequence[tuple[int, int]]) -> Array:
    from scipy.stats import wilcoxon

    # Equal ratios are ties, whatever rounding makes of them.
    logs = np.round(np.log(failures_last(values)), 9)
    first, second = np.array(pairs, dtype=int).reshape(-1, 2).T
    differences = logs[:, first] - logs[:, second]
    p = np.ones(len(pairs))
    told = differences.any(axis=0)
    if told.any():
        # By itself SciPy meets ties with permutations: minutes for all pairs of two dozen methods.
        method: Literal["exact", "approx"] = "exact" if len(values) <= 50 else "approx"
        p[told] = wilcoxon(differences[:, told], axis=0, method=method).pvalue
    return holm(p)


def holm(p: Array) -> Array:
    """p-values (k,) corrected for being k (Holm 1979)."""
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty(len(p))
    out[order] = np.minimum(stepped, 1.0)
    return out


def win_rates(values: Array) -> Array:
    """Share (methods, methods) of the cases (cases, methods) in which row beats column; ties, and
    two failures, count half."""
    ranked = np.where(np.isnan(values), np.inf, values)
    better = ranked[:, :, None] < ranked[:, None, :]
    same = ranked[:, :, None] == ranked[:, None, :]
    return np.asarray((better + 0.5 * same).mean(axis=0))


def performance_profile(values: Array, ratios: Array) -> Array:
    """Share (ratios, methods) of the cases (cases, methods) in which a method is within a ratio of
    the best of that case (Dolan and More 2002). A failure never is."""
    failed = np.isnan(values)
    best = np.where(failed, np.inf, values).min(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(values == best, 1.0, values / best)
    within = (relative <= np.asarray(ratios)[:, None, None]) & ~failed
    return np.asarray(within.mean(axis=1))


def failures_last(values: Array) -> Array:
    """Values (cases, methods) whose failures are ten times the worst of their case."""
    none = np.isnan(values).all(axis=1, keepdims=True)
    worst = np.nanmax(np.where(none, 1.0, values), axis=1)
    return np.where(np.isnan(values), 10.0 * worst[:, None], values)
