"""Bandwidth of a recorded motion."""

from typing import Final

import numpy as np

from sysid_bench.types import Array

SHARE: Final = 0.99
"""Share of the power of the rates below the bandwidth: the highest harmonic of a Fourier motion
whose harmonics are comparable."""

ROUNDING: Final = 1e-12
"""A coordinate that leaves its line by less than this share does not move."""


def bandwidth(q: Array, rate: float) -> float:
    """Return the frequency (Hz) below which a coordinate of q (N, k), sampled at `rate` (Hz), has
    99 % of the power of its rate; the median over those that move, 0 where none does.

    A joint that sticks and slips is faster than its command: the median is that of the motion.

    The spectrum is that of q without its line from end to end, times the squared frequency. The
    mean power of q in the upper half of the band is noise, and is subtracted.
    """
    N = len(q)
    line = q[0] + np.linspace(0.0, 1.0, N)[:, None] * (q[-1] - q[0])
    x = np.where(np.abs(q - line).max(axis=0) > ROUNDING * np.abs(q).max(axis=0), q - line, 0.0)
    power = np.abs(np.fft.rfft(x * np.hanning(N)[:, None], axis=0)) ** 2
    f = np.fft.rfftfreq(N, 1 / rate)
    noise = power[len(f) // 2 :].mean(axis=0)
    moves = np.maximum(power - noise, 0.0) * (f**2)[:, None]
    # A line of noise above its mean is as likely at all frequencies, and f^2 would favour the last.
    moves[power < 10 * noise] = 0.0
    total = moves.sum(axis=0)
    shares = np.cumsum(moves, axis=0)[:, total > 0] / total[total > 0]
    found = [f[np.searchsorted(share, SHARE)] for share in shares.T]
    return float(np.median(found)) if found else 0.0
