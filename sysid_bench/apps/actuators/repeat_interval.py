"""Ranges of parameters from repeated recordings: the scatter between files."""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from sysid_bench.errors import UsageError
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class RepeatInterval:
    """Mean and standard deviation (...) between `count` files, and the interval [low, high] that
    holds the value of a new file with a probability `share`."""

    count: int
    share: float
    mean: Array
    std: Array
    low: Array
    high: Array


def repeat_interval(values: Array, share: float = 0.95) -> RepeatInterval:
    """Return the ranges of values (n, ...) of n files: the prediction interval of Student's t,
    mean +- t_{n-1} s sqrt(1 + 1/n), with s of n - 1.

    Raises UsageError for a single file.
    """
    n = len(values)
    if n < 2:
        raise UsageError("Ranges between files need two files or more; give one more recording.")
    mean, std = values.mean(axis=0), values.std(axis=0, ddof=1)
    reach = float(stdtrit(n - 1, 0.5 * (1.0 + share))) * np.sqrt(1.0 + 1.0 / n) * std
    return RepeatInterval(n, share, mean, std, mean - reach, mean + reach)


def repeat_covariance(values: Array, delays: Array) -> Array:
    """Return the covariance (k, c + 1, c + 1) between n files of each joint's values (n, k, c) and
    of the delays (n,)."""
    whole = np.concatenate(
        [values, np.tile(delays[:, None, None], (1, values.shape[1], 1))], axis=2
    )
    centred = whole - whole.mean(axis=0)
    return np.asarray(np.einsum("nki,nkj->kij", centred, centred) / (len(values) - 1))


def left_out_share(values: Array, share: float = 0.95) -> float:
    """Return the share of values (n, ...) that the ranges of the other n - 1 files hold."""
    inside = []
    for k, own in enumerate(values):
        others = repeat_interval(np.delete(values, k, axis=0), share)
        # Values on a bound in all files have no scatter, and are held.
        inside.append((own >= others.low) & (own <= others.high))
    return float(np.mean(inside))
