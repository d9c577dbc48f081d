"""Coloured noise as a sum of first-order processes that has the autocorrelation of a residual."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import nnls

from sysid_bench.signals.filter import Filter
from sysid_bench.types import Array

NOISE: Final = "torque-noise"
"""Sensor error of a plant file."""

WHITE: Final = 1e-5
"""Time constant (s) of a process that is white at any rate of a recording."""

CONSTANTS: Final = (WHITE, 0.02, 0.05, 0.15, 0.5, 1.5)
"""Time constants (s) of the processes; residuals of recorded arms forget in 0.03 to 2.8 s."""

LONGEST: Final = 3.0
"""Lag (s) up to which the autocorrelation is fitted."""


@dataclass(frozen=True, eq=False)
class ColouredNoise:
    """Standard deviations (len(CONSTANTS), n) of independent processes with each of CONSTANTS, for
    n joints."""

    std: Array

    def entries(self) -> list[dict[str, object]]:
        """Return the entries `torque-noise` of a plant, one for each time constant in use."""
        return [
            {"use": NOISE, "std": row.tolist(), "share": 0.0, "time_constant": constant}
            for constant, row in zip(CONSTANTS, self.std, strict=True)
            if row.any()
        ]


def coloured_noise(
    residuals: Sequence[Array], step: float, filter: Filter, rate: float
) -> ColouredNoise:
    """Return the noise that, sampled at `rate` (Hz) and filtered, has the level and the
    autocorrelation of the residual (N,) of each joint, a sample every `step` (s).

    The autocorrelation is a sum of those of the processes with weights that are not negative.
    """
    processes = [_filtered(constant, rate, filter) for constant in CONSTANTS]
    std = [_deviations(residual, step, processes, rate) for residual in residuals]
    return ColouredNoise(np.array(std).T)


def _deviations(residual: Array, step: float, processes: Sequence[Array], rate: float) -> Array:
    """Standard deviations (len(CONSTANTS),) for one joint."""
    count = max(2, min(len(residual) // 4, round(LONGEST / step)))
    found = time_covariance(residual, count)
    if found[0] <= 0.0:
        return np.zeros(len(CONSTANTS))
    lags = np.arange(count) * step
    basis = np.column_stack([np.interp(lags * rate, np.arange(len(x)), x) for x in processes])
    # The level counts as much as all lags together.
    weights = np.ones(count)
    weights[0] = np.sqrt(count)
    variance, _ = nnls(basis * weights[:, None], found / found[0] * weights)
    level = float(basis[0] @ variance)
    return np.sqrt(variance * found[0] / level) if level > 0 else np.zeros(len(CONSTANTS))


def time_covariance(x: Array, count: int) -> Array:
    """Return the biased autocovariance (count,) of x (N,) about zero, at lags of samples."""
    size = 1 << (2 * len(x) - 1).bit_length()
    power = np.abs(np.fft.rfft(x, size)) ** 2
    return np.asarray(np.fft.irfft(power, size)[:count] / len(x))


def _filtered(constant: float, rate: float, filter: Filter) -> Array:
    """Autocovariance, up to LONGEST, of a first-order process of variance 1 behind a filter."""
    size = 1 << int(np.ceil(np.log2(max(8 * LONGEST, 8 * constant) * rate + 64)))
    impulse = np.zeros((size, 1))
    impulse[size // 2] = 1.0
    gain = np.abs(np.fft.rfft(filter.smooth(impulse, rate)[:, 0])) ** 2
    pole = np.exp(-1.0 / (rate * constant))
    angle = 2 * np.pi * np.arange(len(gain)) / size
    spectrum = (1 - pole**2) / (1 - 2 * pole * np.cos(angle) + pole**2)
    return np.asarray(np.fft.irfft(spectrum * gain, size)[: round(LONGEST * rate) + 2])
