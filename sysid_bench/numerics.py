"""Numerics that packages share: the R factor of tall matrices, the one dense factorisation of all;
the correlation time of a series; and the parts of a motion for cross-validation."""

from collections.abc import Iterable
from typing import Final

import numpy as np
from scipy.linalg import lapack

from sysid_bench.types import Array


def qr_factor(parts: Iterable[Array]) -> Array:
    """Return the R factor (min(m, k), k) of the vertically stacked matrices (m_i, k).

    Its diagonal may be negative. Raises LinAlgError where LAPACK rejects the matrix.
    """
    stack = np.asfortranarray(np.concatenate(list(parts)))
    rows, columns = stack.shape
    if rows == 0 or columns == 0:
        return np.zeros((0, columns))
    # With the default workspace of SciPy's wrapper LAPACK uses its slow, unblocked algorithm.
    packed, _, _, info = lapack.dgeqrf(stack, lwork=64 * columns, overwrite_a=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"LAPACK's dgeqrf rejected argument {-info}.")
    # Below the diagonal LAPACK stores the reflectors that make up Q.
    return np.triu(packed[: min(rows, columns)])


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


_ROUNDING: Final = 1e-9
"""Phase within which a sample is at the edge of a part."""


def time_labels(samples: int, period: float, count: int) -> Array:
    """Return the part (N,), 0 to count - 1, of each of N `samples`: by its phase in the `period`
    (samples, may be a fraction), or in the whole motion where that is 0."""
    periods = np.arange(samples) / (period or max(samples, 1))
    # Samples at the edge of a part belong behind it, rounded or not.
    return np.asarray(np.floor(periods % 1.0 * count + _ROUNDING) % count, dtype=int)
