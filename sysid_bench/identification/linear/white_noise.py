"""Noise level of a sampled signal."""

from math import comb

import numpy as np

from sysid_bench.types import Array

ORDER = 6
"""Order of the difference: it removes a smooth motion and keeps white noise."""


def white_noise(x: Array) -> Array:
    """Standard deviation (k,) of white noise on smooth signals x (N, k).

    MAD of the sixth differences over their gain sqrt(C(12, 6)); a motion well below the sampling
    rate does not contribute.
    """
    # The squared coefficients C(6, k)^2 of the difference sum to C(12, 6).
    gain = np.sqrt(comb(2 * ORDER, ORDER))
    return np.asarray(np.median(np.abs(np.diff(x, ORDER, axis=0)), axis=0) / (0.6745 * gain))
