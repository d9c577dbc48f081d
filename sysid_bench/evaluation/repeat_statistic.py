"""Statistics over repeats of one experiment: bias, scatter and efficiency of a method.

`errors` (n, r) are those of n repeats and r parameters; `bound` (r,) are the standard deviations of
the Cramer-Rao bound, which also make parameters of different units comparable.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.types import Array

ENOUGH_REPEATS: Final = 20
"""With fewer repeats the standard deviation is uncertain by more than 20 %."""

DRAWS: Final = 2000
"""Bootstrap resamples."""


@dataclass(frozen=True, eq=False)
class _Moments:
    """Mean and variance (..., r) of errors, and `chance`, the expected squared mean of an unbiased
    method in variances: 1 / n for n repeats."""

    mean: Array
    variance: Array
    chance: float


Figure = tuple[float, float, float]
"""Value, low and high end of its 95 % bootstrap interval over repeats."""


def share_interval(hits: float, count: int) -> tuple[float, float]:
    """Return the interval of a share, `hits` of `count`, that holds it in at least 95 % (Clopper
    and Pearson 1934).

    It inverts the exact binomial test, which is conservative since counts are whole numbers. A sum
    of shares may take the place of whole hits, and makes it more so: the variance of each is at
    most that of a hit with the same mean.
    """
    from scipy.special import betaincinv  # loads longer than a table takes

    low = float(betaincinv(hits, count - hits + 1, 0.025)) if hits > 0 else 0.0
    high = float(betaincinv(hits + 1, count - hits, 0.975)) if hits < count else 1.0
    return low, high


def mean_error(errors: Array) -> Figure:
    """Return the mean error in standard deviations of a single estimate, RMS over parameters, minus
    its expected value for an unbiased method with n repeats."""

    def statistic(moments: _Moments) -> Array:
        squares = (moments.mean**2 / moments.variance).mean(axis=-1)
        return np.asarray(np.sqrt(np.maximum(squares - moments.chance, 0.0)))

    return _resampled(statistic, errors)


def _spread(errors: Array, bound: Array) -> Figure:
    """Return the standard deviation over repeats, relative to the bound, RMS over parameters."""

    def statistic(moments: _Moments) -> Array:
        return np.asarray(np.sqrt((moments.variance / bound**2).mean(axis=-1)))

    return _resampled(statistic, errors)


def _efficiency(errors: Array, bound: Array) -> Figure:
    """Return the statistical efficiency: variance of the bound over that of the estimates, mean
    over parameters.

    One is the best that an unbiased method can achieve; a biased one may exceed it.
    """

    def statistic(moments: _Moments) -> Array:
        # The mean of 1 / (sample variance of n values) is too large by a factor of about 1 + 2 / n.
        return np.asarray((bound**2 / moments.variance).mean(axis=-1) * (1 - 2 * moments.chance))

    return _resampled(statistic, errors)


def _bound_ratio(errors: Array, bound: Array) -> Figure:
    """Return the RMS error (bias and scatter) relative to the bound, RMS over parameters; one is
    the best that an unbiased method can achieve."""

    def statistic(moments: _Moments) -> Array:
        squares = moments.mean**2 + moments.variance * (1 - moments.chance)
        return np.asarray(np.sqrt((squares / bound**2).mean(axis=-1)))

    return _resampled(statistic, errors)


WITH_BOUND: Final[Mapping[str, Callable[[Array, Array], Figure]]] = {
    "spread": _spread,
    "efficiency": _efficiency,
    "bound_ratio": _bound_ratio,
    "bound_ratio_encoders": _bound_ratio,
}


def _resampled(statistic: Callable[[_Moments], Array], errors: Array) -> Figure:
    """Statistic of the errors, and its interval from bootstrap resamples of the repeats."""
    n = len(errors)
    centre = errors.mean(axis=0)
    moved = errors - centre
    variance = (moved**2).sum(axis=0) / (n - 1)
    value = float(statistic(_Moments(centre, variance, 1 / n)))
    counts = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=DRAWS)
    means = counts @ moved / n
    # Resampling with replacement shrinks the variance by (n - 1) / n once more, and the mean of a
    # resample scatters about a sample mean that has a chance error itself.
    variances = (counts @ moved**2 / n - means**2) * (n / (n - 1)) ** 2
    resampled = statistic(_Moments(centre + means, variances, 2 / n))
    low, high = np.quantile(resampled, [0.025, 0.975])
    return value, float(low), float(high)
