"""Agreement of simulation and recordings: residuals of a twin and of the recorded robot, and
predictions of a recorded comparison of methods by a simulated one, pair by pair of methods."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Final

import numpy as np
from scipy.signal import welch
from scipy.stats import kendalltau

from sysid_bench.apps.twins.fit_twin import time_covariance
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
    flat = [one for draws in drawn for one in draws]
    ratios = []
    for joint in range(real[0].e.shape[1]):
        power, other = _power(real, joint), _power(flat, joint)
        seconds = _seconds(real, joint)
        difference = _spectrum(flat, joint) - _spectrum(real, joint)
        ratio = ResidualRatio(
            level=float(np.sqrt(other / power)) if power > 0 else np.nan,
            memory=_seconds(flat, joint) / seconds,
            spectrum=float(np.sqrt(np.nanmean(difference**2))),
            seconds=seconds,
            rms=float(np.sqrt(power)),
        )
        ratios.append(ratio)
    return ratios


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


CLAIMED: Final = float(np.log(1.10))
"""Difference of logarithms of errors from which on a pair of methods is said to differ."""

EQUAL: Final = float(np.log(1.05))
"""Difference up to which a pair is equal."""

TIE: Final = float(np.log(1.01))
"""Difference within which methods have one rank in Kendall's tau."""

DRAWS: Final = 2000
"""Draws of the bootstrap over robots."""

FEWEST: Final = 5
"""Robots with pairs below which there is no interval."""

Errors = Mapping[str, float]
"""Torque error of each method on one test motion."""


@dataclass(frozen=True)
class VerdictCounts:
    """Pairs of methods of one robot: `claimed` differ in simulation, `false` of them are reversed
    or equal in reality; `real` differ in reality by more than their own spread over tests, `found`
    of them differ in simulation, too, and in the same direction. `misfit`: mean difference of
    ln(e / e_ref) to the reference; `level`: error of the reference in simulation over that in
    reality; `tau`: Kendall's tau-b of the two orders, NaN for fewer than three methods."""

    claimed: int
    false: int
    real: int
    found: int
    misfit: float
    level: float
    tau: float = np.nan


@dataclass(frozen=True)
class Interval:
    """A figure of all robots with its 95 % interval from a bootstrap over clusters of robots; None
    where there is none. `count`: pairs of a share, robots of a median."""

    value: float | None
    low: float | None
    high: float | None
    count: int


def verdict_counts(
    simulated: Sequence[Errors], real: Sequence[Errors], reference: str
) -> VerdictCounts:
    """Return the counts of one robot, from the errors of each test in simulation and reality.

    Logarithms of errors are averaged over the tests; methods that failed in one are left out.
    """
    methods = sorted(set.intersection(*map(set, (*simulated, *real))))
    pairs = [_claim(simulated, real, a, b) for a, b in combinations(methods, 2)]
    # Columns: logarithmic ratio of two methods in simulation and in reality, and its spread there.
    s, r, spread = np.array(pairs, dtype=float).reshape(-1, 3).T
    claimed = np.abs(s) > CLAIMED
    found = np.abs(r) > np.maximum(CLAIMED, spread)
    # Logarithmic ratios to the reference: simulation against reality.
    misfits = [
        abs(_difference(simulated, m, reference) - _difference(real, m, reference))
        for m in methods
        if m != reference
    ]
    return VerdictCounts(
        claimed=int(claimed.sum()),
        false=int((claimed & ((s * r < 0) | (np.abs(r) < EQUAL))).sum()),
        real=int(found.sum()),
        found=int((found & (s * r > 0) & (np.abs(s) > EQUAL)).sum()),
        misfit=float(np.mean(misfits)) if misfits else np.nan,
        level=float(np.exp(_mean_log(simulated, reference) - _mean_log(real, reference))),
        tau=_tau(simulated, real, methods),
    )


def mean_counts(counts: Sequence[VerdictCounts]) -> VerdictCounts:
    """Return the counts of several draws of one robot: sums of pairs, means of the rest."""
    return VerdictCounts(
        claimed=sum(one.claimed for one in counts),
        false=sum(one.false for one in counts),
        real=sum(one.real for one in counts),
        found=sum(one.found for one in counts),
        misfit=_mean([one.misfit for one in counts]),
        level=_mean([one.level for one in counts]),
        tau=_mean([one.tau for one in counts]),
    )


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else np.nan


def robot_share(
    counts: Sequence[VerdictCounts],
    part: Callable[[VerdictCounts], tuple[int, int]],
    clusters: Sequence[str] | None = None,
    seed: int = 0,
) -> Interval:
    """Return a share of pairs, `part` of one robot being (part, whole), with whole robots
    resampled, those of one cluster together (None: each its own)."""
    rows = np.array(list(map(part, counts)), dtype=float).reshape(-1, 2)
    members = _members(len(rows), clusters)
    table = np.array([rows[one].sum(axis=0) for one in members]).reshape(-1, 2)
    total = table.sum(axis=0)
    value = float(total[0] / total[1]) if total[1] > 0 else None
    # Robots without any such pair say nothing of the scatter between robots.
    if int((table[:, 1] > 0).sum()) < FEWEST or value is None:
        return Interval(value, None, None, int(total[1]))
    draws = [table[chosen].sum(axis=0) for chosen in _resampled(len(table), seed)]
    shares = [float(few / many) for few, many in draws if many > 0]
    return Interval(value, *_limits(shares), int(total[1]))


def robot_median(
    values: Sequence[float], clusters: Sequence[str] | None = None, seed: int = 0
) -> Interval:
    """Return the median of one figure of each robot, NaN left out; robots are resampled as for
    shares."""
    x = np.array(values, dtype=float)
    finite = (one[np.isfinite(x[one])] for one in _members(len(x), clusters))
    members = list(filter(len, finite))
    if not members:
        return Interval(None, None, None, 0)
    value, count = float(np.nanmedian(x)), sum(map(len, members))
    if len(members) < FEWEST:
        return Interval(value, None, None, count)
    medians = [
        float(np.median(x[np.concatenate([members[k] for k in chosen])]))
        for chosen in _resampled(len(members), seed)
    ]
    return Interval(value, *_limits(medians), count)


def _members(count: int, clusters: Sequence[str] | None) -> list[Array]:
    """Indices of the robots of each cluster."""
    names = [str(k) for k in range(count)] if clusters is None else list(clusters)
    return [np.flatnonzero(np.array(names) == name) for name in dict.fromkeys(names)]


def _resampled(count: int, seed: int) -> Array:
    return np.random.default_rng(seed).integers(count, size=(DRAWS, count))


def _limits(values: Sequence[float]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def _tau(simulated: Sequence[Errors], real: Sequence[Errors], methods: Sequence[str]) -> float:
    """Kendall's tau-b of two orders; errors within 1 % are ties."""
    if len(methods) < 3:
        return np.nan
    orders = [
        np.round([_mean_log(tests, method) / TIE for method in methods])
        for tests in (simulated, real)
    ]
    return float(kendalltau(*orders).statistic)


def _claim(
    simulated: Sequence[Errors], real: Sequence[Errors], a: str, b: str
) -> tuple[float, float, float]:
    """Difference of the logarithms of two methods in simulation and in reality, and half of its
    range over the tests of reality."""
    each = [np.log(one[a] / one[b]) for one in real]
    return _difference(simulated, a, b), _difference(real, a, b), float(np.ptp(each)) / 2


def _difference(tests: Sequence[Errors], a: str, b: str) -> float:
    return _mean_log(tests, a) - _mean_log(tests, b)


def _mean_log(tests: Sequence[Errors], method: str) -> float:
    return float(np.mean([np.log(one[method]) for one in tests]))
