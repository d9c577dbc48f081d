"""Fourier transforms of a motion: its bandwidth, the period after which it
repeats, and so the folds for cross-validation over time."""

from typing import Final

import numpy as np

from sysid_bench.numerics import time_labels
from sysid_bench.types import Array, Trajectory

SHARE: Final = 0.99
"""Share of the power of the rates below the bandwidth: the highest harmonic of a Fourier motion
whose harmonics are comparable."""

ROUNDING: Final = 1e-12
"""A coordinate that leaves its line by less than this share does not move."""

_SAME: Final = 0.02
"""Mean squared distance of q from itself one period later, relative to its variance, up to which a
motion counts as periodic (measured on recorded arms: 0.0002 to 0.002)."""


def bandwidth(q: Array, rate: float, v: Array | None = None) -> float:
    """Return the frequency (Hz) below which a coordinate of q (N, k), sampled at `rate` (Hz), has
    99 % of the power of its rate; the median over those that move, 0 where none does. Where rates v
    (N, k') were measured, the power is theirs: jittered time stamps add to differences of q.

    A joint that sticks and slips is faster than its command: the median is that of the motion.

    The spectrum is that of the signal without its line from end to end, times the squared frequency
    for q. Its mean power in the upper half of the band is noise, and is subtracted.
    """
    signal, N = q if v is None else v, len(q)
    line = signal[0] + np.linspace(0.0, 1.0, N)[:, None] * (signal[-1] - signal[0])
    apart = np.abs(signal - line).max(axis=0) > ROUNDING * np.abs(signal).max(axis=0)
    x = np.where(apart, signal - line, 0.0)
    power = np.abs(np.fft.rfft(x * np.hanning(N)[:, None], axis=0)) ** 2
    f = np.fft.rfftfreq(N, 1 / rate)
    noise = power[len(f) // 2 :].mean(axis=0)
    weight = np.ones_like(f) if v is not None else f**2  # to the power of the rate
    moves = np.maximum(power - noise, 0.0) * weight[:, None]
    # A line of noise above its mean is as likely at all frequencies, and f^2 would favour the last.
    moves[power < 10 * noise] = 0.0
    total = moves.sum(axis=0)
    shares = np.cumsum(moves, axis=0)[:, total > 0] / total[total > 0]
    found = [f[np.searchsorted(share, SHARE)] for share in shares.T]
    return float(np.median(found)) if found else 0.0


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
