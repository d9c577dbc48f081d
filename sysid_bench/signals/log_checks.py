"""Consistency checks of one recording: held and lost samples, impossible rates and units.

A `Finding` is reported; a contradiction is an error unless the user accepts it by its name.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.types import Array
from sysid_bench.words import FINDINGS

_AGREES: Final = 0.98
"""Correlation of travelled and integrated distances above which a joint counts for the rate."""

_RATE_ERROR: Final = 0.05
"""Relative error above which a declared rate is wrong (measured on 9 real logs: below 0.006)."""

_JOINT_ERROR: Final = 0.15
"""Deviation from the other joints above which a joint's v is reported (the speed estimate of a
drive is off by 18 % on a real arm)."""

_WRONG_COLUMN: Final = 1.5
"""Factor beyond which v cannot be that joint's rate in these units."""

_LAGS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500)
"""Samples over which distances are compared: short ones for fast motion, long ones for noisy v."""

_HOLD: Final = 0.25
"""s; q constant for longer stands still, for shorter a sample was held."""

MANY: Final = 0.5
"""Share of held samples above which the declared rate is not that of the data."""

_SHORTEST: Final = 20
"""Samples; the rate of fewer is not recognised."""

_LARGEST: Final = 1e12
"""Numbers beyond it are not measurements."""

_QUANTILE: Final = (0.8, 1.28)
"""Share of steps, and its quantile in standard deviations of normal numbers: a median would be zero
where positions have few digits."""

_CERTAIN: Final = 8.0
"""Standard deviations of the noise from which a step counts, and from which it is too long."""

_REACHES: Final = (1, 4)
"""Steps before and after: few for fast motion, more for noisy positions."""

_LONGER: Final = 0.6
"""Least excess of a step across a gap, relative to the steps around it."""

_ROUNDING: Final = 1e-3
"""Least noise of a step, relative to the mean step: a motion of few digits has none."""

FASTEST: Final = {"hinge": 50.0, "slide": 20.0}
"""rad/s, m/s: above the speed of any robot joint."""


@dataclass(frozen=True)
class Finding:
    """Observation made `count` times in a recording; `name` is one of FINDINGS, `edit` the change
    of the description where the numbers tell it."""

    name: str
    count: int
    text: str
    contradiction: bool = False
    edit: str = ""


def check_findings(findings: Sequence[Finding], accepted: Sequence[str], where: str) -> None:
    """Raise UsageError for contradictions that were not accepted, or for an unknown name."""
    for name in accepted:
        if name not in FINDINGS:
            raise unknown_name("finding", name, FINDINGS, "Give --accept the names to let pass.")
    refused = [f for f in findings if f.contradiction and f.name not in accepted]
    if refused:
        names = ",".join(dict.fromkeys(finding.name for finding in refused))
        raise UsageError(
            f"{where}: {'; '.join(finding.text for finding in refused)}. Fix the description, or "
            f"go on with --accept {names}."
        )


def check_finite(*signals: Array) -> Array:
    """Return rows (N,) in which any number is not finite, or too large for a measurement."""
    # NaN compares false, so the negation catches it too.
    invalid = [~(np.abs(x) < _LARGEST).all(axis=1) for x in signals]
    return np.asarray(np.any(invalid, axis=0))


def held_rows(x: Array, rate: float) -> tuple[Array, int]:
    """Return rows (N,) that repeat the row before in a short run, and the number of rows that stand
    still for longer. `rate` in Hz."""
    same = np.zeros(len(x), dtype=bool)
    same[1:] = (x[1:] == x[:-1]).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    starts, ends = edges[::2], edges[1::2]
    held, standing = np.zeros(len(x), dtype=bool), 0
    for start, end in zip(starts, ends, strict=True):
        # Runs at either end are the robot waiting, however short they are.
        if (end - start) <= max(_HOLD * rate, 2) and start > 1 and end < len(x):
            held[start:end] = True
        else:
            standing += int(end - start)
    return held, standing


def check_samples(q: Array) -> list[Finding]:
    """Return a finding where samples of a smooth motion q (N, k) are missing.

    A step is compared with the mean of its neighbours, where both are well above the noise.
    """
    scale = np.abs(np.diff(q, axis=0)).mean(axis=0) if len(q) > 1 else np.zeros(q.shape[1])
    q = q[:, scale > 0] / scale[scale > 0]
    reaches = (reach for reach in _REACHES if len(q) > 4 * reach + 1)
    count = max((_lost_samples(q, reach) for reach in reaches), default=0)
    return [Finding("lost", count, f"samples that seem to be lost: {count}")] if count else []


def _lost_samples(q: Array, reach: int) -> int:
    """Return the number of samples missing in q (N, k), in mean steps, by comparison of each step
    with the mean of `reach` steps before and after it."""
    if q.shape[1] == 0:
        return 0
    spans = q[reach:] - q[:-reach]
    expected = (spans[: -reach - 1] + spans[reach + 1 :]) / (2 * reach)
    steps = np.diff(q, axis=0)
    excess = steps[reach:-reach] - expected
    # Joints count by noise and curvature, which few steps across a gap hardly change.
    weight = 1.0 / np.maximum(_deviation(excess), _ROUNDING)
    size = np.linalg.norm(expected * weight, axis=1)
    along = (excess * expected * weight**2).sum(axis=1) / np.maximum(size, 1e-300)
    clear = size > _CERTAIN / reach
    ratio = along[clear] / size[clear]
    # Clocks that jitter make all joints' steps longer and shorter together.
    jitter = _deviation(ratio) if len(ratio) else 0.0
    found = clear & (along > _CERTAIN) & (along > max(_LONGER, _CERTAIN * jitter) * size)
    # After a sample that was held the next one makes up for it: nothing is missing.
    held = np.cumsum(np.concatenate([[0], (steps == 0).all(axis=1)]))
    found &= held[2 * reach + 1 :] == held[: -2 * reach - 1]
    return int(np.round(along[found] / size[found]).sum())


def _deviation(x: Array) -> Array:
    """Standard deviation (k,) of normal numbers x (N, k) with a few others among them."""
    share, quantile = _QUANTILE
    return np.asarray(np.quantile(np.abs(x), share, axis=0) / quantile)


def _speed_ratios(q: Array, v: Array, rate: float) -> Array:
    """Return (k,) distance travelled by q over distance integrated from v at this rate (Hz); NaN
    where the two do not agree.

    Distances over a lag are compared, so that noise of v averages out: for each joint the lag of
    the best agreement.
    """
    # Trapezoidal rule: no lag between the integral of v and q, unlike a running sum.
    integral = np.zeros_like(v)
    integral[1:] = np.cumsum(0.5 * (v[1:] + v[:-1]), axis=0) / rate
    lags = [lag for lag in _LAGS if lag <= len(q) // 5]
    ratios = []
    for x, y in zip(q.T, integral.T, strict=True):
        pairs = [_correlation(x[lag:] - x[:-lag], y[lag:] - y[:-lag]) for lag in lags]
        agreeing = [pair for pair in pairs if pair[0] > _AGREES]
        ratios.append(max(agreeing, key=itemgetter(0), default=(0.0, np.nan))[1])
    return np.array(ratios)


def _correlation(moved: Array, integrated: Array) -> tuple[float, float]:
    """Return the size of the correlation of two distances (N,), and the ratio of their deviations
    with its sign."""
    # Without its mean, an offset of v, such as a drifting zero, does not count.
    moved, integrated = moved - moved.mean(), integrated - integrated.mean()
    sizes = float(np.linalg.norm(moved)), float(np.linalg.norm(integrated))
    if min(sizes) == 0.0:
        return 0.0, np.nan
    correlation = float(moved @ integrated) / (sizes[0] * sizes[1])
    return abs(correlation), np.sign(correlation) * sizes[0] / sizes[1]


def check_rates(
    q: Array, v: Array, rate: float, joints: Sequence[str]
) -> tuple[list[Finding], float | None]:
    """Return findings of v against the differences of q (N, k), and the rate (Hz) at which they
    agree; None where no joint agrees."""
    ratios = _speed_ratios(q, v, rate)
    agreeing = np.flatnonzero(np.isfinite(ratios))
    found = _exchanged(q, v, rate, joints, np.flatnonzero(~np.isfinite(ratios)).tolist())
    if len(agreeing) == 0:
        return found, None
    # A wrong rate scales the ratios of all joints alike, wrong columns and units those of one.
    sizes = np.abs(ratios[agreeing])
    common = float(np.median(sizes))
    # Joints that do not agree with each other, as of exchanged columns, have no rate in common.
    if 2 * np.count_nonzero(np.abs(sizes / common - 1) < _JOINT_ERROR) <= len(agreeing):
        common = 1.0
    if abs(common - 1) > _RATE_ERROR:
        text = (
            f"v and the differences of q agree at {rate / common:.4g} Hz, not at the rate of "
            f"{rate:.6g} Hz"
        )
        # The ratio of rad to deg.
        if abs(common * 180 / np.pi - 1) < _RATE_ERROR:
            text += ", or v is in deg/s, or q in rad"
        elif abs(common * np.pi / 180 - 1) < _RATE_ERROR:
            text += ", or q is in deg"
        found.append(Finding("rate", len(q), text, contradiction=True))
    for j in agreeing.tolist():
        # How far the joint moves compared with the others.
        relative = ratios[j] / common
        if relative < 0:
            text = f"v of joint {joints[j]!r} has the opposite sign of its q's motion"
            found.append(Finding("velocity", len(q), text, contradiction=True))
        elif len(agreeing) > 1 and abs(relative - 1) > _JOINT_ERROR:
            text = (
                f"joint {joints[j]!r} moves {relative:.3g} times as far as its v says, compared "
                "with the other joints: check units, ratio and column"
            )
            contradiction = not 1 / _WRONG_COLUMN < relative < _WRONG_COLUMN
            found.append(Finding("velocity", len(q), text, contradiction))
    return found, rate / common


def _exchanged(
    q: Array, v: Array, rate: float, joints: Sequence[str], disagreeing: list[int]
) -> list[Finding]:
    """Return findings of joints whose q does not agree with its own v, but with another's.

    A v that agrees with its own q as well is not exchanged: joints that move alike, or one whose v
    is not recorded.
    """
    found = []
    for j in disagreeing:
        others = [k for k in disagreeing if k != j]
        own = np.repeat(q[:, [j]], len(others), axis=1)
        alike = np.isfinite(_speed_ratios(own, v[:, others], rate))
        if alike.any():
            other = joints[others[int(np.argmax(alike))]]
            text = (
                f"joint {joints[j]!r} moves as v of joint {other!r} says, not as its own: columns "
                "are exchanged"
            )
            found.append(Finding("velocity", len(q), text, contradiction=True))
    return found


def is_rate(x: Array, y: Array) -> bool:
    """Test whether y (N, k) is the time derivative of x (N, k) in all columns that move, at one
    common rate: torques and forces have a ratio of their own in each joint."""
    if x.shape != y.shape or len(x) < _SHORTEST or check_finite(x, y).any():
        return False
    moving = (np.ptp(x, axis=0) > 0) & (np.ptp(y, axis=0) > 0)
    ratios = _speed_ratios(x[:, moving], y[:, moving], 1.0)
    if not moving.any() or not np.isfinite(ratios).all():
        return False
    return bool(ratios.min() > 0 and ratios.max() <= (1 + _RATE_ERROR) * ratios.min())


def check_limits(
    name: str, x: Array, largest: Array, joints: Sequence[str], unit: Sequence[str]
) -> list[Finding]:
    """Return findings of x (N, k) beyond `largest` (k,), which the joint cannot reach in any case:
    wrong units."""
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
