"""Agreement of simulation and recordings: residuals of a twin and of the recorded robot, and
predictions of a recorded comparison of methods by a simulated one, pair by pair of methods."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, Final

import numpy as np
from scipy.signal import welch
from scipy.stats import kendalltau

from sysid_bench.apps.twins.fit_twin import time_covariance
from sysid_bench.evaluation.intervals import ROBOT_TYPES, percentile_interval
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
        power, other = (
            float(np.mean([np.mean(one.e[:, joint] ** 2) for one in residuals]))
            for residuals in (real, flat)
        )
        seconds, other_seconds = (
            geometric_mean([residual_correlation_time(x.e[:, joint], x.rate) for x in residuals])
            for residuals in (real, flat)
        )
        difference = _spectrum(flat, joint) - _spectrum(real, joint)
        ratio = ResidualRatio(
            level=float(np.sqrt(other / power)) if power > 0 else np.nan,
            memory=other_seconds / seconds,
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
        # A replay has a rate of its own, which divides that of the controllers: it is read at the
        # times of the recording.
        columns = [np.interp(t[inside], again.t, column) for column in again.e.T]
        e = one.e[inside]
        # Mean squares add up test by test: a long test does not outweigh the others.
        left = left + np.mean((e - np.column_stack(columns)) ** 2, axis=0)
        power = power + np.mean(e**2, axis=0)
    return np.asarray(1.0 - left / power)


def torque_errors(residuals: Sequence[Residual]) -> float:
    """Return the RMS over joints and tests of the residual over the RMS of the joint's torque."""
    power = np.mean([np.mean(one.e**2, axis=0) for one in residuals], axis=0)
    torque = np.mean([np.mean(one.torque**2, axis=0) for one in residuals], axis=0)
    return float(np.sqrt(np.mean(power[torque > 0] / torque[torque > 0])))


def geometric_mean(values: Sequence[float]) -> float:
    """Return exp of the mean logarithm."""
    return float(np.exp(np.mean(np.log(values))))


def residual_correlation_time(x: Array, rate: float) -> float:
    """Return the lag (s) at which the autocorrelation of x (N,), sampled at `rate` (Hz), falls to
    1/e, between samples linearly; half a sample at least."""
    # Half of the record at most: behind longer lags few products are left to average.
    count = max(2, len(x) // 2)
    found = time_covariance(x - x.mean(), count)
    if found[0] <= 0.0:
        return 0.5 / rate
    below = np.flatnonzero(found < found[0] / np.e)
    if len(below) == 0:
        # It never falls that far: the record says no more than that the memory is longer.
        return count / rate
    k = int(below[0])
    part = (found[k - 1] - found[0] / np.e) / (found[k - 1] - found[k])
    return max(0.5, k - 1 + float(part)) / rate


def _spectrum(residuals: Sequence[Residual], joint: int) -> Array:
    """Power in octave bands, dB, averaged over the tests; NaN in bands that no test resolves."""
    edges = LOWEST * 2.0 ** np.arange(round(np.log2(HIGHEST / LOWEST)) + 1)
    bands = np.full((len(residuals), len(edges) - 1), np.nan)
    for row, one in zip(bands, residuals, strict=True):
        samples = min(len(one.e), round(SEGMENT * one.rate))
        f, density = welch(one.e[:, joint], one.rate, nperseg=samples)
        for k, (low, high) in enumerate(pairwise(edges)):
            inside = (f >= low) & (f < high)
            if inside.any():
                # An exact replay has no power at all, of which there would be no logarithm.
                row[k] = density[inside].mean() + 1e-30
    resolved = ~np.isnan(bands)
    # Powers are averaged, and not decibels, whose mean is one of ratios.
    total = np.where(resolved, bands, 0.0).sum(axis=0)
    count = resolved.sum(axis=0)
    return np.asarray(10 * np.log10(np.where(count > 0, total / np.maximum(count, 1), np.nan)))


CLAIMED: Final = float(np.log(1.10))
"""Difference of logarithms of errors from which on a pair of methods is said to differ."""

EQUAL: Final = float(np.log(1.05))
"""Difference up to which a pair is equal."""

TIE: Final = float(np.log(1.01))
"""Difference within which methods have one rank in Kendall's tau."""

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
    """A figure of all robots with its interval from a bootstrap over clusters of robots; None where
    there is none. `count`: pairs of a share, robots of a median."""

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
    # A method that failed somewhere would be compared on the easier tests.
    methods = sorted(set.intersection(*map(set, (*simulated, *real))))
    # Logarithms: a method twice as bad on one test and half as bad on another is even.
    own, other = (
        {m: float(np.mean([np.log(one[m]) for one in tests])) for m in methods}
        for tests in (simulated, real)
    )
    pairs = []
    for a, b in combinations(methods, 2):
        each = [np.log(one[a] / one[b]) for one in real]
        pairs.append((own[a] - own[b], other[a] - other[b], float(np.ptp(each)) / 2))
    # Columns: logarithmic ratio of two methods in simulation and in reality, and half of its range
    # over the tests of reality.
    s, r, spread = np.array(pairs, dtype=float).reshape(-1, 3).T
    claimed = np.abs(s) > CLAIMED
    # A real difference exceeds what the same pair differs by from one test to the next.
    found = np.abs(r) > np.maximum(CLAIMED, spread)
    # Logarithmic ratios to the reference: simulation against reality.
    misfits = [
        abs((own[m] - own[reference]) - (other[m] - other[reference]))
        for m in methods
        if m != reference
    ]
    tau = np.nan
    if len(methods) >= 3:  # tau-b: errors within 1 % are ties
        orders = [np.round([logs[m] / TIE for m in methods]) for logs in (own, other)]
        tau = float(kendalltau(*orders).statistic)
    return VerdictCounts(
        claimed=int(claimed.sum()),
        # False where reality has the other sign, and where it shows no difference at all.
        false=int((claimed & ((s * r < 0) | (np.abs(r) < EQUAL))).sum()),
        real=int(found.sum()),
        found=int((found & (s * r > 0) & (np.abs(s) > EQUAL)).sum()),
        misfit=float(np.mean(misfits)) if misfits else np.nan,
        level=float(np.exp(own[reference] - other[reference])),
        tau=tau,
    )


def mean_counts(counts: Sequence[VerdictCounts]) -> VerdictCounts:
    """Return the counts of several draws of one robot: sums of pairs, means of the rest."""
    values: dict[str, Any] = {}
    for name in VerdictCounts.__dataclass_fields__:
        each = [getattr(one, name) for one in counts]
        # Pairs add up, so that a share over draws weighs each draw by what it claims.
        if name in ("claimed", "false", "real", "found"):
            values[name] = sum(each)
        else:
            known = [value for value in each if np.isfinite(value)]
            values[name] = float(np.mean(known)) if known else np.nan
    return VerdictCounts(**values)


def robot_share(
    counts: Sequence[VerdictCounts],
    part: Callable[[VerdictCounts], tuple[int, int]],
    clusters: Sequence[str] | None = None,
) -> Interval:
    """Return a share of pairs, `part` of one robot being (part, whole), with whole robots
    resampled, those of one cluster together (None: each its own)."""
    rows = np.array(list(map(part, counts)), dtype=float).reshape(-1, 2)
    members = _members(len(rows), clusters)
    table = np.array([rows[one].sum(axis=0) for one in members]).reshape(-1, 2)
    few, many = table.sum(axis=0)
    value = float(few / many) if many > 0 else None
    # Robots without any such pair say nothing of the scatter between robots.
    if value is None or np.count_nonzero(table[:, 1]) < ROBOT_TYPES.fewest:
        return Interval(value, None, None, int(many))
    # The ratio of sums: robots count by their pairs, and are drawn as wholes, since pairs of one
    # robot share its errors.
    drawn = table[ROBOT_TYPES.indices(len(table))].sum(axis=1)
    # A draw of robots without any such pair has no share.
    drawn = drawn[drawn[:, 1] > 0]
    low, high = percentile_interval(drawn[:, 0] / drawn[:, 1])
    return Interval(value, float(low), float(high), int(many))


def robot_median(values: Sequence[float], clusters: Sequence[str] | None = None) -> Interval:
    """Return the median of one figure of each robot, NaN left out; robots are resampled as for
    shares."""
    x = np.array(values, dtype=float)
    finite = (one[np.isfinite(x[one])] for one in _members(len(x), clusters))
    members = list(filter(len, finite))
    if not members:
        return Interval(None, None, None, 0)
    value, count = float(np.nanmedian(x)), sum(map(len, members))
    if len(members) < ROBOT_TYPES.fewest:
        return Interval(value, None, None, count)
    draws = ROBOT_TYPES.indices(len(members))
    medians = [np.median(x[np.concatenate([members[k] for k in chosen])]) for chosen in draws]
    low, high = percentile_interval(np.array(medians))
    return Interval(value, float(low), float(high), count)


def _members(count: int, clusters: Sequence[str] | None) -> list[Array]:
    """Indices of the robots of each cluster."""
    names = [str(k) for k in range(count)] if clusters is None else list(clusters)
    return [np.flatnonzero(np.array(names) == name) for name in dict.fromkeys(names)]
