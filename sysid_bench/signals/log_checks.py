"""What is wrong with a recording, by itself: held and lost samples, rates and units that cannot be.

A `Finding` is told; a contradiction is an error unless the user accepts it by its name.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.types import Array

NAMES: Final = ("rate", "velocity", "units", "held", "lost", "non-finite", "time", "limits")
"""What can be found, and accepted."""

AGREES: Final = 0.98
"""Correlation of travelled and integrated distances from which a joint has a say in the rate."""

RATE_ERROR: Final = 0.05
"""Relative; from here on a declared rate is wrong (measured on 9 real logs: below 0.006)."""

JOINT_ERROR: Final = 0.15
"""Relative to the other joints; from here on one joint's rate is told to be off (a drive's own
estimate of speed may be, by 18 % on a real arm)."""

OTHER: Final = 1.5
"""A factor from which on it cannot be that joint's rate in these units."""

HOLD: Final = 0.25
"""s; q that stays for longer stands still, for shorter a sample was held."""

MANY: Final = 0.5
"""Share of rows that are held from which the declared rate is not that of the data."""

LARGEST: Final = 1e12
"""A number beyond it is no measurement."""

FASTEST: Final = {"hinge": 50.0, "slide": 20.0}
"""rad/s, m/s: no robot joint is as fast."""


@dataclass(frozen=True)
class Finding:
    """Something found `count` times in a recording."""

    name: str
    count: int
    text: str
    contradiction: bool = False


def refuse_findings(findings: Sequence[Finding], accepted: Sequence[str], where: str) -> None:
    """Raises UsageError for contradictions that were not accepted, or for an unknown name."""
    for name in accepted:
        if name not in NAMES:
            raise unknown_name("finding", name, NAMES, "Give those that --accept is to let pass.")
    refused = [f for f in findings if f.contradiction and f.name not in accepted]
    if refused:
        names = ",".join(dict.fromkeys(finding.name for finding in refused))
        raise UsageError(
            f"{where}: {'; '.join(finding.text for finding in refused)}. Mend the description, or "
            f"go on with --accept {names}."
        )


def bad_rows(*signals: Array) -> Array:
    """Rows (N,) in which any number is not finite or beyond all measurement."""
    return np.any(
        [~(np.abs(x) < LARGEST).all(axis=1) for x in signals],  # NaN compares false
        axis=0,
    )


def held_rows(x: Array, rate: float) -> tuple[Array, int]:
    """Rows (N,) that repeat the row before in a short run, and how many stand still for longer."""
    same = np.zeros(len(x), dtype=bool)
    same[1:] = (x[1:] == x[:-1]).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    starts, ends = edges[::2], edges[1::2]
    held, standing = np.zeros(len(x), dtype=bool), 0
    for start, end in zip(starts, ends, strict=True):
        if (end - start) <= max(HOLD * rate, 2) and start > 1 and end < len(x):
            held[start:end] = True
        else:
            standing += int(end - start)
    return held, standing


def lost_steps(q: Array) -> Array:
    """Rows (N,) of a smooth motion before which samples are missing: how many. A step is compared
    with the mean of its neighbours, where the robot moves faster than usual."""
    steps = np.diff(q, axis=0)
    scale = np.abs(steps).mean(axis=0)
    steps = steps[:, scale > 0] / scale[scale > 0]
    lost = np.zeros(len(q), dtype=int)
    if len(steps) < 5 or steps.shape[1] == 0:
        return lost
    around = 0.5 * (steps[:-2] + steps[2:])
    size = (around**2).sum(axis=1)
    quick = size > np.median(size)
    ratio = (steps[1:-1] * around).sum(axis=1) / np.where(quick, size, 1.0)
    found = quick & (ratio > 1.6)
    lost[2:-1][found] = np.round(ratio[found]).astype(int) - 1
    return lost


def _speed_ratios(q: Array, v: Array, rate: float) -> Array:
    """(k,): how many times as far each joint moves as its rate says at this sampling rate; NaN
    where the two do not agree well enough to tell.

    Distances over a lag are compared, so that noise of v averages out: for each joint the lag at
    which they agree best.
    """
    ratios = np.full(q.shape[1], np.nan)
    integral = np.zeros_like(v)
    integral[1:] = np.cumsum(0.5 * (v[1:] + v[:-1]), axis=0) / rate
    lags = [lag for lag in (1, 2, 5, 10, 20, 50, 100, 200, 500) if lag <= len(q) // 5]
    for j in range(q.shape[1]):
        best = AGREES
        for lag in lags:
            moved, told = q[lag:, j] - q[:-lag, j], integral[lag:, j] - integral[:-lag, j]
            moved, told = moved - moved.mean(), told - told.mean()
            sizes = float(np.linalg.norm(moved)), float(np.linalg.norm(told))
            if min(sizes) == 0.0:
                continue
            agreement = float(moved @ told) / (sizes[0] * sizes[1])
            if abs(agreement) > best:
                best = abs(agreement)
                ratios[j] = np.sign(agreement) * sizes[0] / sizes[1]
    return ratios


def check_rates(
    q: Array, v: Array, rate: float, joints: Sequence[str]
) -> tuple[list[Finding], float | None]:
    """What v against the differences of q tells, and the rate (Hz) at which they agree."""
    ratios = _speed_ratios(q, v, rate)
    sure = np.isfinite(ratios)
    found = _of_others(q, v, rate, joints, np.flatnonzero(~sure))
    if not sure.any():
        return found, None
    common = float(np.median(np.abs(ratios[sure])))
    measured = rate / common
    if abs(common - 1) > RATE_ERROR:
        doubt = ""
        if abs(common * 180 / np.pi - 1) < RATE_ERROR:
            doubt = ", or v is in deg/s, or q in rad"
        elif abs(common * np.pi / 180 - 1) < RATE_ERROR:
            doubt = ", or q is in deg"
        text = (
            f"a rate of {rate:.6g} Hz is declared, but v and the differences of q agree at "
            f"{measured:.4g} Hz{doubt}"
        )
        found.append(Finding("rate", len(q), text, contradiction=True))
    for j in (int(j) for j in np.flatnonzero(sure)):
        own = ratios[j] / common
        if own < 0:
            text = f"v of joint {joints[j]!r} runs against its q: a sign is wrong"
            found.append(Finding("velocity", len(q), text, contradiction=True))
        elif sure.sum() > 1 and abs(own - 1) > JOINT_ERROR:
            text = (
                f"joint {joints[j]!r} moves {own:.3g} times as far as its v says, against the "
                "other joints: units, ratio or column"
            )
            wild = not 1 / OTHER < own < OTHER
            found.append(Finding("velocity", len(q), text, wild))
    return found, measured


def _of_others(
    q: Array, v: Array, rate: float, joints: Sequence[str], doubtful: Array
) -> list[Finding]:
    """Joints whose q does not go with their own v, but with that of another: columns exchanged."""
    found = []
    for j in doubtful:
        told = _speed_ratios(np.repeat(q[:, [j]], v.shape[1], axis=1), v, rate)
        others = np.flatnonzero(np.isfinite(told))
        if len(others):
            text = (
                f"joint {joints[j]!r} moves as v of joint {joints[others[0]]!r} says, not as its "
                "own: a column is another's"
            )
            found.append(Finding("velocity", len(q), text, contradiction=True))
    return found


def check_ranges(
    name: str, x: Array, largest: Array, joints: Sequence[str], unit: Sequence[str]
) -> list[Finding]:
    """Numbers beyond what the joint can do at all (k,): hardly its units."""
    found = []
    for j, limit in enumerate(largest):
        size = np.abs(x[:, j])
        count = int((size > limit).sum())
        if count:
            text = (
                f"{name} of joint {joints[j]!r} is beyond {limit:.4g} {unit[j]} in {count} of "
                f"{len(x)} samples (up to {size.max():.4g}): its unit, gain, ratio or offset "
                "cannot be right"
            )
            found.append(Finding("units", count, text, contradiction=True))
    return found
