"""How much of a signal is noise, from the signal alone."""

from math import comb

import numpy as np

from sysid_bench.types import Array

ORDER = 6
"""Of the difference that leaves white noise and takes a smooth motion away."""


def white_noise(x: Array) -> Array:
    """Standard deviation (k,) of white noise on smooth signals x (N, k): the median size of sixth
    differences, which a motion well below the sampling rate does not reach."""
    gain = np.sqrt(comb(2 * ORDER, ORDER))
    return np.median(np.abs(np.diff(x, ORDER, axis=0)), axis=0) / (0.6745 * gain)
