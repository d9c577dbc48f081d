"""Statistics over repeats of one experiment: bias, scatter, efficiency, and the worst coverage.

`errors` (n, r) are those of n repeats and r parameters; `bound` (r,) are the standard deviations of
the Cramer-Rao bound, which also make parameters of different units comparable.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sysid_bench.evaluation.intervals import REPEATS, percentile_interval, share_interval
from sysid_bench.types import Array
from sysid_bench.words import STD_FROM

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class _Moments:
    """Mean and variance (..., r) of errors, and `chance`, the expected squared mean of an unbiased
    method in variances: 1 / n for n repeats."""

    mean: Array
    variance: Array
    chance: float


Figure = tuple[float, float, float]
"""Value, low and high end of its 95 % bootstrap interval over repeats."""


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
    counts = REPEATS.counts(n)
    means = counts @ moved / n
    # Resampling with replacement shrinks the variance by (n - 1) / n once more, and the mean of a
    # resample scatters about a sample mean that has a chance error itself.
    variances = (counts @ moved**2 / n - means**2) * (n / (n - 1)) ** 2
    low, high = percentile_interval(statistic(_Moments(centre + means, variances, 2 / n)))
    return value, float(low), float(high)


SETTING: Final = (
    *("robot", "payload", "task", "terms", "plant", "prior", "excitation", "motions", "held_out"),
    *("simulation", "rate", "noise", "signals", "pipeline", "estimator"),
)
HELD: Final = tuple(f"held_{kind}" for kind in ("motions", "periods", "residuals", "textbook"))
ENCODER_BOUND: Final = "bound_encoders"
"""Bound with the noise of encoders, of the first repeat."""

PARAMETER_COLUMNS: Final = (
    *("id", "body", "name", "base_error", "bound", ENCODER_BOUND, "class"),
    *HELD,
)
"""Columns of the parameters that are read here."""


WORST: Final = {f"coverage_worst_{one}": one for one in ("inertial", "friction")}
"""Class of parameters by metric of the worst coverage."""


def repeat_statistic(
    metric: str, cells: "pd.DataFrame", parameters: "pd.DataFrame"
) -> Figure | None:
    """A figure of all repeats of some cells; of several settings together where there are several.

    None where fewer than REPEATS.fewest gave numbers, where all of them gave the same, or, for what
    is measured by the bound, where a parameter has none.
    """
    if metric in WORST:
        return _worst_coverage(WORST[metric], cells, parameters)
    of_encoders = metric == "bound_ratio_encoders"
    errors, bound = repeat_errors(cells, parameters, ENCODER_BOUND if of_encoders else "bound")
    if not (
        len(errors) >= REPEATS.fewest and errors.size > 0 and bool(np.ptp(errors, axis=0).all())
    ):
        return None
    if metric == "bias":
        return mean_error(errors)
    return WITH_BOUND[metric](errors, bound) if np.isfinite(bound).all() else None


def _worst_coverage(one: str, cells: "pd.DataFrame", parameters: "pd.DataFrame") -> Figure | None:
    """Share of repeats whose intervals hold the value, of the parameter of a class where it is
    smallest, and its 95 % interval (Clopper and Pearson 1934); None where a group of cells has
    several kinds of intervals, or too few repeats."""
    kinds: list[str] = cells[STD_FROM].unique().tolist() if STD_FROM in cells.columns else []
    if len(kinds) != 1 or f"held_{kinds[0]}" not in parameters.columns:
        return None
    column = f"held_{kinds[0]}"
    lines = parameters[(parameters["class"] == one) & parameters[column].notna()]
    settings = _settings(cells)
    lines = lines.merge(cells[["id", *settings]], on="id")
    groups = lines.groupby([*settings, "body", "name"])[column]
    hits, counts = groups.sum().to_numpy(dtype=int), groups.count().to_numpy(dtype=int)
    if len(counts) == 0 or counts.min() < REPEATS.fewest:
        return None
    worst = int(np.argmin(hits / counts))
    hit, count = int(hits[worst]), int(counts[worst])
    return (hit / count, *share_interval(hit, count))


def _settings(cells: "pd.DataFrame") -> list[str]:
    return [name for name in SETTING if name in cells.columns]


def repeat_errors(
    cells: "pd.DataFrame", parameters: "pd.DataFrame", which: str = "bound"
) -> tuple[Array, Array]:
    """Errors (n, r) of each base parameter of each setting (r) in the repeats (n) that all of them
    have, and the bound (r,), NaN where there is none: the root mean square of those of single
    repeats, which differ where noise disturbs the motion."""
    settings = _settings(cells)
    lines = parameters[parameters["id"].isin(cells["id"]) & parameters["base_error"].notna()]
    lines = lines.merge(cells[["id", "repeat", *settings]], on="id")
    if len(lines) == 0:
        return np.zeros((0, 0)), np.zeros(0)
    given = lines[which].astype(float) if which in lines else np.nan
    lines = lines.assign(square=given**2)
    where = [*settings, "body", "name"]
    # A repeat that failed in one setting is left out of all, so that the rows are complete.
    errors = lines.pivot(index="repeat", columns=where, values="base_error").dropna()
    squares = lines.pivot(index="repeat", columns=where, values="square")
    # The bound with encoders is that of the first repeat alone.
    first_alone = which == ENCODER_BOUND
    known = squares[errors.columns] if first_alone else squares[errors.columns].loc[errors.index]
    bound = np.sqrt(known.mean(axis=0, skipna=first_alone))
    return errors.to_numpy(dtype=float), bound.to_numpy(dtype=float)
