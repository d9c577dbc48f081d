"""Integrated autocorrelation time of a series."""

import numpy as np

from sysid_bench.types import Array


def correlation_time(x: Array, longest: int | None = None) -> float:
    """Return one plus twice the sum of the correlations of x (N,), in samples, up to the first that
    is not positive (Geyer, Statistical Science 7, 1992), or up to the lag `longest`."""
    power = np.abs(np.fft.rfft(x, 2 * len(x))) ** 2
    correlation = np.fft.irfft(power)[: len(x)] / max(float(x @ x), 1e-300)
    ends = np.flatnonzero(correlation <= 0.0)
    first = int(ends[0]) if len(ends) else len(x)
    if longest is not None:
        first = min(first, longest + 1)
    return max(2.0 * float(correlation[:first].sum()) - 1.0, 1.0)
