"""Comparison of a twin's residual with that of the recorded robot: level, spectrum and memory."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.signal import welch

from sysid_bench.apps.twins.coloured_noise import time_covariance
from sysid_bench.types import Array

LOWEST, HIGHEST = 0.2, 12.8
"""Hz: octave bands of the spectra; filters leave little above."""

SEGMENT: Final = 10.0
"""s: segments of the spectra."""


@dataclass(frozen=True, eq=False)
class Residual:
    """Residual e (N, n) of a method on one test motion, at `rate` (Hz), with the measured torque
    (N, n) and the time t (N,) of each sample in its recording."""

    e: Array
    torque: Array
    rate: float
    t: Array


@dataclass(frozen=True)
class ResidualRatio:
    """A twin's residual on test motions over that of the robot, for one joint or all: `level`, the
    ratio of the RMS; `memory`, the ratio of the autocorrelation times; `spectrum`, the RMS over
    octave bands of the difference of the spectra (dB). `seconds` and `rms` are the robot's own
    autocorrelation time and RMS residual."""

    level: float
    memory: float
    spectrum: float
    seconds: float
    rms: float


def residual_ratio(
    real: Sequence[Residual], drawn: Sequence[Sequence[Residual]]
) -> list[ResidualRatio]:
    """Return the likeness of each joint, from the tests of the robot and, for each, those of some
    draws of the twin's noise. Powers, and logarithms of autocorrelation times, are averaged."""
    return [_likeness(real, drawn, j) for j in range(real[0].e.shape[1])]


def residual_share(real: Sequence[Residual], repeated: Sequence[Residual]) -> Array:
    """Return the share (n,) of the power of a robot's residual on its tests that the residual of a
    replay without noise explains: 1 - sum (e - e')^2 / sum e^2, sample by sample.

    The motion of a replay begins at the first sample of the robot's residual, at t = 0. Below 0
    where it is farther from the robot's residual than zero is, as coloured noise is.
    """
    left, power = 0.0, 0.0
    for one, again in zip(real, repeated, strict=True):
        t = one.t - one.t[0]
        inside = (t >= again.t[0]) & (t <= again.t[-1])
        columns = [np.interp(t[inside], again.t, column) for column in again.e.T]
        e = one.e[inside]
        left = left + np.mean((e - np.column_stack(columns)) ** 2, axis=0)
        power = power + np.mean(e**2, axis=0)
    return np.asarray(1.0 - left / power)


def torque_errors(residuals: Sequence[Residual]) -> float:
    """Return the RMS over joints and tests of the residual over the RMS of the joint's torque."""
    power = np.mean([np.mean(one.e**2, axis=0) for one in residuals], axis=0)
    torque = np.mean([np.mean(one.torque**2, axis=0) for one in residuals], axis=0)
    return float(np.sqrt(np.mean(power[torque > 0] / torque[torque > 0])))


def _likeness(
    real: Sequence[Residual], drawn: Sequence[Sequence[Residual]], joint: int
) -> ResidualRatio:
    flat = [one for draws in drawn for one in draws]
    power, other = _power(real, joint), _power(flat, joint)
    seconds, again = _seconds(real, joint), _seconds(flat, joint)
    difference = _spectrum(flat, joint) - _spectrum(real, joint)
    return ResidualRatio(
        level=float(np.sqrt(other / power)) if power > 0 else np.nan,
        memory=again / seconds,
        spectrum=float(np.sqrt(np.nanmean(difference**2))),
        seconds=seconds,
        rms=float(np.sqrt(power)),
    )


def _power(residuals: Sequence[Residual], joint: int) -> float:
    return float(np.mean([np.mean(one.e[:, joint] ** 2) for one in residuals]))


def _seconds(residuals: Sequence[Residual], joint: int) -> float:
    """Geometric mean of the autocorrelation times (s)."""
    times = [residual_correlation_time(one.e[:, joint], one.rate) for one in residuals]
    return float(np.exp(np.mean(np.log(times))))


def residual_correlation_time(x: Array, rate: float) -> float:
    """Return the lag (s) at which the autocorrelation of x (N,), sampled at `rate` (Hz), falls to
    1/e, between samples linearly; half a sample at least."""
    count = max(2, len(x) // 2)
    found = time_covariance(x - x.mean(), count)
    if found[0] <= 0.0:
        return 0.5 / rate
    below = np.flatnonzero(found < found[0] / np.e)
    if len(below) == 0:
        return count / rate
    k = int(below[0])
    part = (found[k - 1] - found[0] / np.e) / (found[k - 1] - found[k])
    return max(0.5, k - 1 + float(part)) / rate


def _spectrum(residuals: Sequence[Residual], joint: int) -> Array:
    """Power in octave bands, dB, averaged over the tests; NaN in bands that no test resolves."""
    bands = np.array([_bands(one, joint) for one in residuals])
    resolved = ~np.isnan(bands)
    total = np.where(resolved, bands, 0.0).sum(axis=0)
    count = resolved.sum(axis=0)
    return np.asarray(10 * np.log10(np.where(count > 0, total / np.maximum(count, 1), np.nan)))


def _bands(residual: Residual, joint: int) -> Array:
    samples = min(len(residual.e), round(SEGMENT * residual.rate))
    f, density = welch(residual.e[:, joint], residual.rate, nperseg=samples)
    edges = LOWEST * 2.0 ** np.arange(round(np.log2(HIGHEST / LOWEST)) + 1)
    inside = [(f >= low) & (f < high) for low, high in pairwise(edges)]
    means = [density[band].mean() if band.any() else np.nan for band in inside]
    return np.array(means) + 1e-30
