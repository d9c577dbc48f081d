"""Butterworth low-pass as sections of second order, run forward and backward.

The same filter as `scipy.signal.butter` and `sosfiltfilt`, to rounding: loading that package takes
longer than a recording of minutes takes to be filtered. Sections are recursions
`y[n] = b0 x[n] + b1 x[n-1] + b2 x[n-2] - a1 y[n-1] - a2 y[n-2]`, that is banded triangular systems.
"""

from functools import lru_cache
from typing import Final

import numpy as np

from sysid_bench.types import Array

BLOCK: Final = 4096
"""Samples of one banded system."""


def butterworth_filter(order: int, cutoff: float, rate: float) -> Array:
    """Return the sections (k, 6), each b0 b1 b2 1 a1 a2, of a low-pass with `cutoff` and `rate` in
    Hz: the analog poles by the bilinear transform, their frequency warped before."""
    warped = np.tan(np.pi * cutoff / rate)
    angles = np.pi / (2.0 * order) * np.arange(order - 1, 0, -2)
    poles = sorted((_digital(-warped * np.exp(1j * angle)) for angle in angles), key=abs)
    # Poles near the unit circle come last: what they amplify has passed the others.
    pairs = [_section(1.0, 2.0, 1.0, -2.0 * pole.real, abs(pole) ** 2) for pole in poles]
    if order % 2:
        pairs.insert(0, _section(1.0, 1.0, 0.0, -_digital(complex(-warped)).real, 0.0))
    return np.array(pairs)


def _digital(pole: complex) -> complex:
    """Return the pole of the sampled filter, with the frequency in units of twice the rate."""
    return (1.0 + pole) / (1.0 - pole)


def _section(*coefficients: float) -> Array:
    """Return b0 b1 b2 1 a1 a2 of a section with the gain 1 at rest."""
    b, a = np.array(coefficients[:3]), np.array([1.0, *coefficients[3:]])
    return np.concatenate([b * (a.sum() / b.sum()), a])


def apply_filter(sections: Array, x: Array, pad: int) -> Array:
    """Return x (N, k) filtered along time in both directions, with the phase zero.

    Each end is continued by `pad` samples, turned about its last value, and the filter starts at
    rest in the first of them (Gustafsson 1996 compares such starts).
    """
    y = _continued(np.asarray(x, dtype=float), pad)
    for _ in range(2):
        for section in sections:
            _run(section, y)
        y = y[::-1]
    return np.array(y[pad : len(y) - pad], order="C")


def _continued(x: Array, pad: int) -> Array:
    """Return x (N, k) with both ends turned about their last values; columns lie together."""
    y = np.empty((len(x) + 2 * pad, *x.shape[1:]), order="F")
    y[pad : pad + len(x)] = x
    if pad:
        y[:pad] = 2.0 * x[0] - x[pad:0:-1]
        y[len(y) - pad :] = 2.0 * x[-1] - x[-2 : -pad - 2 : -1]
    return y


def _run(section: Array, x: Array) -> None:
    """Replace x (N, k) by its response, from rest at the first sample on."""
    from scipy.linalg import lapack  # names of filters are checked without it

    b, a = section[:3], section[3:]
    # At rest all samples before the first one equal it, and so does the response.
    before, after = np.repeat(x[:1], 2, axis=0), np.repeat(x[:1], 2, axis=0)
    for first in range(0, len(x), BLOCK):
        part = x[first : first + BLOCK]
        known = np.concatenate([before, part])
        y = b[0] * known[2:] + b[1] * known[1:-1] + b[2] * known[:-2]
        y[0] -= a[1] * after[1] + a[2] * after[0]
        if len(y) > 1:
            y[1] -= a[2] * after[1]
        solved, _ = lapack.dtbtrs(_band(*a[1:], len(y)), y, uplo="L", diag="U")
        before, after = known[-2:], np.concatenate([after, solved])[-2:]
        x[first : first + BLOCK] = solved


@lru_cache(maxsize=64)
def _band(a1: float, a2: float, count: int) -> Array:
    """Return the lower band (3, count) of the recursion, as LAPACK stores it."""
    band = np.empty((3, count), order="F")
    band[0], band[1], band[2] = 1.0, a1, a2
    return band
