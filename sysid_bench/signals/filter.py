"""Zero-phase filters as suites write them: "none", "butter 4 20 Hz zero-phase", "average 21", and
"fourier 2 Hz" for periodic motions.

The Butterworth low-pass is the one of `scipy.signal.butter` and `sosfiltfilt`, to rounding: loading
that package takes longer than a recording of minutes takes to be filtered. It is a product of
sections of second order, recursions that are banded triangular systems:
`y[n] = b0 x[n] + b1 x[n-1] + b2 x[n-2] - a1 y[n-1] - a2 y[n-2]`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.types import Array
from sysid_bench.units import quantity

BLOCK: Final = 4096
"""Samples of one banded system."""


@dataclass(frozen=True)
class NoFilter:
    """Identity: signals as recorded."""

    def smooth(self, x: Array, rate: float) -> Array:
        """Return x (N, k) itself."""
        return x

    def edge(self, rate: float) -> int:
        """Return the number of samples at each end with a start-up transient."""
        return 0


@dataclass(frozen=True)
class Butterworth:
    """Butterworth low-pass run forward and backward: zero phase, twice the order.

    Gain 1 / (1 + (f / cutoff)^(2 order)), `cutoff` in Hz: -6 dB there, since both runs count.
    """

    order: int
    cutoff: float

    def smooth(self, x: Array, rate: float) -> Array:
        """Return x (N, k) filtered along time; raises UsageError for a cut-off above half the rate
        (Hz)."""
        if not 0 < self.cutoff < rate / 2:
            raise UsageError(
                f"A cut-off of {self.cutoff} Hz needs a rate above twice that; it is {rate} Hz."
            )
        pad = min(len(x) - 1, 3 * self.edge(rate))
        y = _continued(np.asarray(x, dtype=float), pad)
        # From rest at the first sample, in both directions (Gustafsson 1996 compares such starts).
        for _ in range(2):
            for section in _sections(self.order, self.cutoff, rate):
                _run(section, y)
            y = y[::-1]
        return np.array(y[pad : len(y) - pad], order="C")

    def edge(self, rate: float) -> int:
        """Return the samples of one period of the cut-off, after which the impulse response has
        decayed."""
        return int(np.ceil(rate / self.cutoff))


@lru_cache(maxsize=64)
def _sections(order: int, cutoff: float, rate: float) -> Array:
    """Return the sections (k, 6), each b0 b1 b2 1 a1 a2, of a low-pass with `cutoff` and `rate` in
    Hz: the analog poles by the bilinear transform, their frequency warped before."""
    warped = np.tan(np.pi * cutoff / rate)
    angles = np.pi / (2.0 * order) * np.arange(order - 1, 0, -2)
    poles = sorted((_digital(-warped * np.exp(1j * angle)) for angle in angles), key=abs)
    # One transfer function of order 8 would lose its digits. Poles near the unit circle come last:
    # what they amplify has passed the others.
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


@dataclass(frozen=True)
class MovingAverage:
    """Centred moving average over an odd number of samples."""

    window: int

    def smooth(self, x: Array, rate: float) -> Array:
        """Return x (N, k) averaged along time; windows at the ends are cut short."""
        # Dividing by the samples inside the window keeps a constant signal constant at the ends.
        kernel = np.ones(self.window)
        count = np.convolve(np.ones(len(x)), kernel, "same")
        columns = [np.convolve(column, kernel, "same") / count for column in x.T]
        return np.stack(columns, axis=1)

    def edge(self, rate: float) -> int:
        """Return half the window."""
        return self.window // 2


@dataclass(frozen=True)
class FourierFilter:
    """Fourier series of a recording of whole periods, truncated at `cutoff` (Hz).

    Motions of slower harmonics pass unchanged, and their derivatives are exact (Swevers, Ganseman,
    Tukel, De Schutter, Van Brussel 1997).
    """

    cutoff: float

    def smooth(self, x: Array, rate: float) -> Array:
        """Return x (N, k) without its faster harmonics."""
        return self._series(x, rate, 0)

    def derivative(self, x: Array, rate: float) -> Array:
        """Return dx/dt (N, k) of the truncated series."""
        return self._series(x, rate, 1)

    def _series(self, x: Array, rate: float, order: int) -> Array:
        # Each derivative multiplies a harmonic by j 2 pi f.
        f = np.fft.rfftfreq(len(x), 1 / rate)
        factor = np.where(f <= self.cutoff, (2j * np.pi * f) ** order, 0.0)
        return np.fft.irfft(factor[:, None] * np.fft.rfft(x, axis=0), len(x), axis=0)

    def edge(self, rate: float) -> int:
        """Return 0: the end of a whole period continues at its start."""
        return 0


Filter = NoFilter | Butterworth | MovingAverage | FourierFilter
FORMS: Final[Mapping[str, type[Filter]]] = MappingProxyType(
    {
        "none": NoFilter,
        "butter ORDER CUTOFF Hz zero-phase": Butterworth,
        "average N": MovingAverage,
        "fourier CUTOFF Hz": FourierFilter,
    }
)
"""Filters by the text that names them; N is odd."""


def derivative(filter: Filter, x: Array, rate: float, accuracy: int = 2) -> Array:
    """Return dx/dt (N, k) of a filtered signal: of its Fourier series, or central differences.

    `accuracy` is the order in the sampling time T: 2 (three points) has at the angular frequency w
    the gain sin(wT) / (wT) = 1 - (wT)^2 / 6 + ..., 4 (five points) 1 - (wT)^4 / 30 + ... Beside the
    ends, where points are missing, it is 2, and 1 at the ends.
    """
    if isinstance(filter, FourierFilter):
        return filter.derivative(x, rate)
    slope = np.asarray(np.gradient(x, 1.0 / rate, axis=0))
    if accuracy == 4 and len(x) > 4:
        # Richardson's extrapolation of the differences over T and 2 T.
        slope[2:-2] = (4 * slope[2:-2] - (x[4:] - x[:-4]) * rate / 4) / 3
    return slope


def filter_of(text: str) -> Filter:
    """Return the filter that a text describes; raises UsageError with the forms that exist."""
    words = text.split()
    if words[-1:] == ["zero-phase"]:
        words.pop()
    match words:
        case ["none"]:
            return NoFilter()
        case ["butter", order, number, *unit] if order.isdecimal() and int(order) > 0:
            return Butterworth(int(order), _cutoff([number, *unit], text))
        case ["fourier", number, *unit]:
            return FourierFilter(_cutoff([number, *unit], text))
        case ["average", window] if window.isdecimal() and int(window) % 2 == 1:
            return MovingAverage(int(window))
    raise UsageError(
        f"{text!r} is not a filter; write one of {', '.join(map(repr, FORMS))}, N odd."
    )


def _cutoff(words: list[str], text: str) -> float:
    """Return a cut-off in Hz; raises UsageError unless it is positive."""
    cutoff = quantity(" ".join(words), "Hz")
    if not cutoff > 0:
        raise UsageError(f"{text!r}: a cut-off must be positive; got {cutoff} Hz.")
    return cutoff
