"""Zero-phase filters as a suite writes them: "butter 4 20 Hz zero-phase", "average 21", "none"."""

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


Filter = NoFilter | Butterworth | MovingAverage


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
        case ["average", window] if window.isdecimal() and int(window) % 2 == 1:
            return MovingAverage(int(window))
    raise UsageError(
        f"{text!r} is no filter; write 'none', 'butter ORDER CUTOFF Hz zero-phase' or 'average N', "
        "N odd."
    )


def _positive(cutoff: float, text: str) -> float:
    if not cutoff > 0:
        raise UsageError(f"{text!r}: a cut-off must be positive; got {cutoff} Hz.")
    return cutoff
