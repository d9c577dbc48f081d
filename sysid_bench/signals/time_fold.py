"""Folds for cross-validation over time: parts of a motion's period, or of its whole duration."""

from typing import Final

import numpy as np

from sysid_bench.numerics import time_labels
from sysid_bench.types import Array, Trajectory

_SAME: Final = 0.02
"""Mean squared distance of q from itself one period later, relative to its variance, up to which a
motion counts as periodic (measured on recorded arms: 0.0002 to 0.002)."""


def time_fold(motion: Trajectory, count: int) -> tuple[Array, str]:
    """Return the fold (N,) 0 ... count - 1 of each sample, and a description of the folds.

    Samples one period apart share a fold, or the left-out part would be known from its repetition.
    """
    period = repetition(motion)
    words = f"a period of {period} samples" if period else "time"
    return time_labels(len(motion), period, count), f"{count} stretches of {words}"


def repetition(motion: Trajectory) -> int:
    """Return the samples after which a motion repeats: its period, or the one that its positions
    show where none is declared; 0 where it does not repeat."""
    return motion.period_samples or repetition_period(motion.q) or 0


def repetition_period(q: Array) -> int | None:
    """Return the period in samples of a motion q (N, nq); None where it does not repeat."""
    spread = q.std(axis=0)
    x = (q - q.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    if x.shape[1] == 0:
        return None
    N = len(x)
    # Sum over joints of the autocorrelation by FFT, divided by the samples that overlap.
    size = 1 << (2 * N - 1).bit_length()
    F = np.fft.rfft(x, size, axis=0)
    product = np.fft.irfft((np.abs(F) ** 2).sum(axis=1), size)[:N]
    squares = np.concatenate([[0.0], np.cumsum((x**2).sum(axis=1))])
    lag = np.arange(N)
    energy = squares[N - lag] + squares[N] - squares[lag]
    distance = (energy - 2 * product) / (x.shape[1] * (N - lag))
    # At a lag of a few samples any motion is near itself: look for the period after it has left.
    away = np.flatnonzero(distance > 0.5)
    if len(away) == 0:
        return None
    later = distance[away[0] : N - N // 4]
    if len(later) == 0 or later.min() > _SAME:
        return None
    first = int(np.flatnonzero(later <= max(_SAME, 2 * later.min()))[0])
    window = later[first : first + max(away[0], 10)]
    return int(away[0]) + first + int(np.argmin(window))
