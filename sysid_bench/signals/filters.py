"""Zero-phase filters as a suite writes them: "butter 4 20 Hz zero-phase", "average 21", "none",
and "fourier 2 Hz" of motions that repeat."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.types import Array
from sysid_bench.units import quantity


@dataclass(frozen=True)
class NoFilter:
    """Signals as they come."""

    def smooth(self, x: Array, rate: float) -> Array:
        """x (N, k) itself."""
        return x

    def edge(self, rate: float) -> int:
        """Samples at each end that the filter's start spoils."""
        return 0


@dataclass(frozen=True)
class Butterworth:
    """Forward and backward Butterworth: no phase, the order twice. `cutoff` in Hz."""

    order: int
    cutoff: float

    def smooth(self, x: Array, rate: float) -> Array:
        """x (N, k) filtered along time; raises UsageError for a cut-off above half the rate."""
        from scipy.signal import butter, sosfiltfilt

        if not 0 < self.cutoff < rate / 2:
            raise UsageError(
                f"A cut-off of {self.cutoff} Hz needs a rate above twice that; it is {rate} Hz."
            )
        sections = butter(self.order, self.cutoff, fs=rate, output="sos")
        pad = min(len(x) - 1, 3 * self.edge(rate))
        return np.asarray(sosfiltfilt(sections, x, axis=0, padlen=pad))

    def edge(self, rate: float) -> int:
        """One period of the cut-off: the impulse response has died away."""
        return int(np.ceil(rate / self.cutoff))


@dataclass(frozen=True)
class MovingAverage:
    """Centred average over an odd number of samples."""

    window: int

    def smooth(self, x: Array, rate: float) -> Array:
        """x (N, k) averaged along time; the ends average what there is."""
        kernel = np.ones(self.window)
        count = np.convolve(np.ones(len(x)), kernel, "same")
        columns = [np.convolve(column, kernel, "same") / count for column in x.T]
        return np.stack(columns, axis=1)

    def edge(self, rate: float) -> int:
        """Half the window."""
        return self.window // 2


@dataclass(frozen=True)
class FourierSeries:
    """What is not faster than `cutoff` (Hz) in the series of a recording of whole periods: it
    neither rounds nor delays a motion of slower harmonics, and its derivatives are exact (Swevers,
    Ganseman, Tukel, De Schutter, Van Brussel 1997)."""

    cutoff: float

    def smooth(self, x: Array, rate: float) -> Array:
        """x (N, k) without what is faster."""
        return self._series(x, rate, 0)

    def derivative(self, x: Array, rate: float) -> Array:
        """dx/dt (N, k) of what is not faster."""
        return self._series(x, rate, 1)

    def _series(self, x: Array, rate: float, order: int) -> Array:
        f = np.fft.rfftfreq(len(x), 1 / rate)
        factor = np.where(f <= self.cutoff, (2j * np.pi * f) ** order, 0.0)
        return np.fft.irfft(factor[:, None] * np.fft.rfft(x, axis=0), len(x), axis=0)

    def edge(self, rate: float) -> int:
        """None: the end goes on at the start."""
        return 0


Filter = NoFilter | Butterworth | MovingAverage | FourierSeries


def derivative(filter: Filter, x: Array, rate: float) -> Array:
    """dx/dt (N, k) of what a filter has smoothed: of its series, or else central differences."""
    if isinstance(filter, FourierSeries):
        return filter.derivative(x, rate)
    return np.asarray(np.gradient(x, 1.0 / rate, axis=0))


def filter_of(text: str) -> Filter:
    """The filter that a text names; raises UsageError with the forms that exist."""
    words = text.split()
    if words and words[-1] == "zero-phase":
        words.pop()
    match words:
        case ["none"]:
            return NoFilter()
        case ["butter", order, *cutoff] if order.isdecimal() and cutoff and int(order) > 0:
            return Butterworth(int(order), _positive(quantity(" ".join(cutoff), "Hz"), text))
        case ["fourier", *cutoff] if cutoff:
            return FourierSeries(_positive(quantity(" ".join(cutoff), "Hz"), text))
        case ["average", window] if window.isdecimal() and int(window) % 2 == 1:
            return MovingAverage(int(window))
    raise UsageError(
        f"{text!r} is no filter; write 'none', 'butter ORDER CUTOFF Hz zero-phase', 'average N' (N "
        "odd) or 'fourier CUTOFF Hz'."
    )


def _positive(cutoff: float, text: str) -> float:
    if not cutoff > 0:
        raise UsageError(f"{text!r}: a cut-off must be positive; got {cutoff} Hz.")
    return cutoff
