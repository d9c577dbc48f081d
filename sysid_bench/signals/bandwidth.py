"""Bandwidth of a recorded motion."""

from typing import Final

import numpy as np

from sysid_bench.types import Array

SHARE: Final = 0.99
"""Share of the power of the rates below the bandwidth: the highest harmonic of a Fourier motion
whose harmonics are comparable."""

ROUNDING: Final = 1e-12
"""A coordinate that leaves its line by less than this share does not move."""


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
