"""Delay of commands: profile of the fit over it, and its separation from armature and damping.

An assumed delay that is d too long lowers the torque by about d (kp v + kd a): what that differs
from armature and damping alone separates them, and model errors of that size hide it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from operator import itemgetter
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import (
    SIGNED,
    Fit,
    Group,
    bounded_fit,
    independent_samples,
)
from sysid_bench.apps.actuators.drive_rows import DriveRows
from sysid_bench.evaluation.intervals import likelihood_drop
from sysid_bench.types import Array

LONGEST: Final = 0.02
"""s, of the delays that are tried at rates from 100 Hz on."""

MOST: Final = 0.2
"""s, up to which they are extended while the longest one fits best: radio links and cameras are
below it."""

SAMPLES: Final = 2.0
"""Longest of them at lower rates, in samples."""

AHEAD: Final = 3.84
"""Twice the loss of log-likelihood (95 % quantile of chi-squared) by which a negative delay has to
fit better."""

FLAT: Final = 1e-6
"""Largest difference of losses that are rounding errors."""

FINE: Final = 501
"""Points of a piece among which the best delay is sought: 0.01 ms at 200 Hz."""


@dataclass(frozen=True, eq=False)
class DelayProfile:
    """Fits at `delays` (d,) in s, and `loss` (d,): twice the log-likelihood below the best one's.

    `best`: its minimum, between them as well; `interval`: where the loss is below
    `likelihood_drop`; `ahead`: a delay half a sample below zero fits better still, by more than
    AHEAD.
    """

    delays: Array
    fits: tuple[Fit, ...]
    loss: Array
    best: float
    interval: tuple[float, float]
    ahead: bool = False

    @property
    def on_edge(self) -> bool:
        """Test whether the best delay is the longest that was tried."""
        return bool(len(self.delays) > 1 and self.best >= self.delays[-1])


def delay_grid(rate: float, longest: float = LONGEST) -> Array:
    """Return delays (d,) up to a longest (s) or SAMPLES samples, half a sample apart: five or
    more."""
    return np.arange(0.0, max(longest, SAMPLES / rate) + 1e-9, 0.5 / rate)


def delay_profile(
    rows: DriveRows,
    groups: Sequence[Group],
    delays: Array,
    between: bool = True,
    scale: Array | None = None,
) -> DelayProfile:
    """Return the profile over delays (s); `between`: the best may lie between two of them; `scale`
    (k,): see `bounded_fit`."""

    @cache
    def fit_at(delay: float) -> Fit:
        return bounded_fit(groups, rows.torque(delay), rows.rate, scale)

    fits = tuple(map(fit_at, delays.tolist()))
    # A profile and not a point: without the bounds the best delay of legs is 17.5 to 20 ms, with
    # negative armatures.
    first = min(fits, key=lambda fit: float(fit.errors.sum()))
    # One count for all delays: losses of different counts could not be compared.
    counts = independent_samples(first.residuals, rows.rate)
    loss = np.array([_loss(fit.errors, counts) + fit.penalty for fit in fits])
    best, lowest = float(delays[np.argmin(loss)]), float(loss.min())
    if between and np.ptp(loss) >= FLAT:
        # Pieces (3,) of the grid that hold its best delay, each with its middle: between odd
        # multiples of half a sample the torque of held commands is linear in the delay.
        ends = np.unique(np.concatenate([delays[:1], delays[1::2], delays[-1:]])).tolist()
        pieces = [
            np.array([low, 0.5 * (low + high), high])
            for low, high in pairwise(ends)
            if low <= best <= high
        ]
        found = [_lowest(piece, list(map(fit_at, piece.tolist())), counts) for piece in pieces]
        best, lowest = min(found, key=itemgetter(1))
    ahead = False
    if best == 0.0:
        # No drive acts before its command: where that fits better, q_des is stamped late.
        early = fit_at(-0.5 / rows.rate)
        ahead = bool(_loss(early.errors, counts) + early.penalty < lowest - AHEAD)
    loss = loss - lowest
    low = _end(delays[delays < best][::-1], loss[delays < best][::-1], best)
    high = _end(delays[delays > best], loss[delays > best], best)
    return DelayProfile(delays, fits, loss, best, (low, high), ahead)


def _loss(errors: Array, counts: Array) -> Array:
    """Return twice the loss of log-likelihood (...) of RMS residuals (..., k): the scale of a
    joint's residuals is unknown, so that its log-likelihood is -n/2 log of their square."""
    return np.asarray((counts * np.log(np.maximum(errors, 1e-12) ** 2)).sum(axis=-1))


def _lowest(piece: Array, fits: Sequence[Fit], counts: Array) -> tuple[float, float]:
    """Return delay and loss of the minimum in a piece (3,) with its fits: the squared residuals of
    each joint are a parabola there, and their logarithm is not."""
    share = np.linspace(0.0, 1.0, FINE)[:, None]
    # Lagrange's polynomials of the points 0, 1/2 and 1.
    rest = 1.0 - share
    weights = np.hstack([rest * (rest - share), 4.0 * share * rest, share * (share - rest)])
    squares = weights @ np.array([fit.errors**2 for fit in fits])
    penalty = weights @ np.array([fit.penalty for fit in fits])
    loss = _loss(np.sqrt(np.maximum(squares, 0.0)), counts) + penalty
    best = int(np.argmin(loss))
    return float((piece[0] + share[:, 0] * (piece[-1] - piece[0]))[best]), float(loss[best])


def _end(x: Array, loss: Array, best: float) -> float:
    """Return the delay on one side of the best at which the loss reaches `likelihood_drop`, by a
    parabola through the nearest point there; the end of the grid where it does not. x and loss are
    ordered away from the best."""
    drop = likelihood_drop()
    above = np.flatnonzero(loss > drop)
    if len(above) == 0:
        return float(x[-1]) if len(x) else best
    far = int(above[0])
    # Near its minimum the loss is a parabola, so that its root is linear in the delay.
    inner = (best, 0.0) if far == 0 else (float(x[far - 1]), float(max(loss[far - 1], 0.0)))
    low, high, edge = np.sqrt(inner[1]), np.sqrt(loss[far]), np.sqrt(drop)
    return float(inner[0] + (x[far] - inner[0]) * (edge - low) / (high - low))


RESOLVED: Final = 0.005
"""s; a delay that a recording leaves open by more is confounded. Measured: 19 to 22 ms on legs
under one set of gains, below 2 ms in simulations with two."""

STEP: Final = 0.25
"""Samples by which the delay is changed for its effect."""

ROUNDING: Final = 1e-9
"""Share of the largest torque: a delay that changes the torque by less has no effect."""


@dataclass(frozen=True, eq=False)
class DelayInformation:
    """`share`: of the delay's effect on the torque that armature, friction and offset do not give;
    `open` (s): error of the delay whose effect, without that of the others, is as large as the
    residuals, infinite where commands do not change; `direction` (k, 4): change of the values per
    second of delay, in the order of UNKNOWNS."""

    share: float
    open: float
    direction: Array

    @property
    def is_open(self) -> bool:
        """Test whether delay and armature cannot be separated."""
        return self.open > RESOLVED

    @property
    def is_static(self) -> bool:
        """Test whether the commands do not change, so that their delay has no effect."""
        return not np.isfinite(self.open)


def delay_information(
    rows: DriveRows, groups: Sequence[Group], delay: float, fit: Fit
) -> DelayInformation:
    """Return how far the delay (s) is separated from the values of a fit at it."""
    effect = delay_effect(rows, delay)
    left, direction = np.empty_like(effect), np.zeros((effect.shape[1], SIGNED + 1))
    if not effect.any():
        return DelayInformation(0.0, np.inf, direction)
    for group in groups:
        c = effect[:, group.joints].T.ravel()
        # Without bounds: what the values could take up of the delay, in either direction.
        x = np.linalg.lstsq(group.A, c, rcond=None)[0]
        rest = c - group.A @ x
        for i, j in enumerate(group.joints):
            direction[j] = group.gain[0] * x[group.columns(i)[: SIGNED + 1]]
            left[:, j] = rest[i * group.samples : (i + 1) * group.samples]
    # In units of the residuals: a share below them does not separate the delay from the others.
    scale = np.maximum(fit.errors, 1e-12)
    whole, apart = (float(np.sqrt(np.mean((x / scale) ** 2))) for x in (effect, left))
    return DelayInformation(apart / whole, 1.0 / apart, direction)


def delay_effect(rows: DriveRows, delay: float) -> Array:
    """Return the change (N, k) of the torque per second of delay, at a delay (s); zero where it is
    within ROUNDING."""
    step = STEP / rows.rate
    ends = max(delay - step, 0.0), delay + step
    early, late = (rows.torque(end) for end in ends)
    if np.abs(late - early).max() <= ROUNDING * max(np.abs(late).max(), np.abs(rows.links).max()):
        return np.zeros_like(late)
    return np.asarray((late - early) / (ends[1] - ends[0]))
