"""Statistics of a group of cells, and their intervals."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from sysid_bench.evaluation.intervals import LEVEL_TEXT, TABLE_REPEATS, percentile_interval

STATISTICS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "median": "median",
        "mean": "mean",
        "min": "smallest value",
        "max": "largest value",
        "count": "number of cells with a value",
    }
)
INTERVALS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "no interval",
        "iqr": "interquartile range",
        "std": "plus and minus one standard deviation",
        "range": "smallest and largest value",
        "ci95": f"{LEVEL_TEXT} bootstrap interval over repeats",
    }
)
Interval = tuple[float | None, float | None]


def statistic_of(stat: str, values: np.ndarray) -> float:
    """A statistic of finite values (n,), n > 0."""
    return float(_along_last(stat, values))


def interval_of(interval: str, stat: str, values: np.ndarray, repeats: np.ndarray) -> Interval:
    """(low, high) for finite values (n,) of the given repeats (n,); (None, None) where two values
    (or, for "ci95", two repeats) are missing, and for counts."""
    if interval == "none" or stat == "count" or len(values) < 2:
        return None, None
    if interval == "ci95":
        return _bootstrap(stat, values, repeats)
    low, high = _spread(interval, stat, values)
    return float(low), float(high)


def _spread(interval: str, stat: str, values: np.ndarray) -> tuple[float, float]:
    """Ends of an interval that describes the values, not the accuracy of their statistic."""
    if interval == "iqr":
        low, high = np.percentile(values, [25, 75])
        return low, high
    if interval == "range":
        return values.min(), values.max()
    centre, spread = statistic_of(stat, values), values.std(ddof=1)
    return centre - spread, centre + spread


def _bootstrap(stat: str, values: np.ndarray, repeats: np.ndarray) -> Interval:
    """Percentile interval; whole repeats are drawn, since cells of one repeat share their noise."""
    names, which = np.unique(repeats.astype(str), return_inverse=True)
    if len(names) < TABLE_REPEATS.fewest:
        return None, None
    # One row per repeat: a draw of rows is a draw of repeats, all of them at once.
    blocks = np.full((len(names), np.bincount(which).max()), np.nan)
    for i in range(len(names)):
        block = values[which == i]
        blocks[i, : len(block)] = block
    drawn = blocks[TABLE_REPEATS.indices(len(names))].reshape(TABLE_REPEATS.draws, -1)
    low, high = percentile_interval(_along_last(stat, drawn))
    return float(low), float(high)


def _along_last(stat: str, values: np.ndarray) -> np.ndarray:
    if stat == "count":
        return np.asarray(np.isfinite(values).sum(axis=-1))
    # Blocks of unequal repeats are filled with NaN; every draw holds at least one number.
    functions: dict[str, Callable[..., np.ndarray]] = {
        "median": np.nanmedian,
        "mean": np.nanmean,
        "min": np.nanmin,
        "max": np.nanmax,
    }
    return np.asarray(functions[stat](values, axis=-1))
