"""Repeats of one experiment: how far a method is off on average, how much it scatters, and how near
that comes to the bound of Cramer and Rao.

Errors (n, r) of n repeats and r parameters; the bound (r,) as standard deviations, which are also
the unit that kilograms and kilogram square metres have in common.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.types import Array

ENOUGH_REPEATS: Final = 20
"""Fewer tell of a scatter to no better than a fifth of it."""

DRAWS: Final = 2000


@dataclass(frozen=True, eq=False)
class _Moments:
    """Of errors: mean and variance (..., r), and what of the squared mean, in variances, is chance:
    1 / n of n repeats."""

    mean: Array
    variance: Array
    chance: float


Figure = tuple[float, float, float]
"""Value, and the ends of its 95 % interval by resampling repeats."""


def bias(errors: Array) -> Figure:
    """The mean error in standard deviations of a single estimate, RMS over parameters, less what
    chance adds to it with so many repeats."""

    def statistic(of: _Moments) -> Array:
        squares = (of.mean**2 / of.variance).mean(axis=-1)
        return np.asarray(np.sqrt(np.maximum(squares - of.chance, 0.0)))

    return _resampled(statistic, errors)


def spread(errors: Array, bound: Array) -> Figure:
    """The standard deviation over repeats in those of the bound, RMS over parameters."""
    return _resampled(lambda of: np.sqrt((of.variance / bound**2).mean(axis=-1)), errors)


def efficiency(errors: Array, bound: Array) -> Figure:
    """The bound's variance over that of the estimates, mean over parameters.

    One: as sure as any unbiased method can be. A biased method may seem to exceed it.
    """

    def statistic(of: _Moments) -> Array:
        # One over a variance of n numbers is too large by 2 / n in the mean.
        return np.asarray((bound**2 / of.variance).mean(axis=-1) * (1 - 2 * of.chance))

    return _resampled(statistic, errors)


def bound_ratio(errors: Array, bound: Array) -> Figure:
    """The RMS error, bias and scatter together, in standard deviations of the bound, RMS over
    parameters: how far a method is from the best that an unbiased one could be."""

    def statistic(of: _Moments) -> Array:
        squares = of.mean**2 + of.variance * (1 - of.chance)
        return np.asarray(np.sqrt((squares / bound**2).mean(axis=-1)))

    return _resampled(statistic, errors)


WITH_BOUND: Final[Mapping[str, Callable[[Array, Array], Figure]]] = {
    "spread": spread,
    "efficiency": efficiency,
    "bound_ratio": bound_ratio,
}


def _resampled(statistic: Callable[[_Moments], Array], errors: Array) -> Figure:
    n = len(errors)
    centre = errors.mean(axis=0)
    moved = errors - centre
    variance = (moved**2).sum(axis=0) / (n - 1)
    told = float(statistic(_Moments(centre, variance, 1 / n)))
    counts = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=DRAWS)
    means = counts @ moved / n
    # Repeats drawn twice are no news: the variance of a resample is short by (n - 1) / n once more,
    # and its mean scatters around one that is off by chance itself.
    variances = (counts @ moved**2 / n - means**2) * (n / (n - 1)) ** 2
    again = statistic(_Moments(centre + means, variances, 2 / n))
    low, high = np.quantile(again, [0.025, 0.975])
    return told, float(low), float(high)
