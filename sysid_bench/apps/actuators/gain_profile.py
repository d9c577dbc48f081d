"""Gain of position controllers whose kp and kd are not known: profile of the fit over it.

Divided by the gain s, tau - tau_links / s = (Ia a + fv v + fc s(v) + offset) / s: commands alone
determine ratios to kp, and the torque of links whose masses are known determines s. Each value of s
leaves a bounded linear fit, so that no simulation, which could diverge, is needed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from sysid_bench.apps.actuators.bounded_fit import (
    Group,
    bounded_fit,
    independent_samples,
    solve_bounded,
)
from sysid_bench.apps.actuators.drive_rows import DriveRows
from sysid_bench.evaluation.intervals import coverage_factor, likelihood_drop
from sysid_bench.types import Array

LARGEST: Final = 1e3
"""Gains from 1 / LARGEST to LARGEST of the stated ones are tried: kp in degrees is off by 57."""

POINTS: Final = 61
"""Gains of the grid: ten in a decade."""

DECIDED: Final = 10.0
"""Largest ratio of the ends of an interval that determines the gain: a decade."""


@dataclass(frozen=True, eq=False)
class GainProfile:
    """Gain of joints (indices), over the stated one, with its `interval` (0 and infinite where it
    is open). `is_open`: the recordings do not determine it, and it stays as it was stated."""

    joints: tuple[int, ...]
    gain: float
    interval: tuple[float, float]

    @property
    def is_open(self) -> bool:
        """Test whether only ratios to kp are determined."""
        low, high = self.interval
        return not high <= DECIDED * low

    @property
    def std(self) -> float:
        """Standard deviation of 1 / gain."""
        low, high = self.interval
        return 0.0 if self.is_open else (1.0 / low - 1.0 / high) / (2.0 * coverage_factor(np.inf))


def gain_profiles(
    rows: DriveRows, groups: Sequence[Group], delay: float, by_group: bool
) -> tuple[GainProfile, ...]:
    """Return the gains at a delay (s): one of each group, or of all joints with one stated kp."""
    tau = rows.torque(delay)
    # Without a share of the file's armature: its ratio to kp would decide on the gain.
    groups = [replace(group, gain=(1.0, 0.0), low=None) for group in groups]
    first = bounded_fit(groups, tau, rows.rate)
    counts = independent_samples(first.residuals, rows.rate)
    sets: dict[object, list[Group]] = {}
    for i, group in enumerate(groups):
        sets.setdefault(i if by_group else rows.gains[group.joints[0]], []).append(group)
    return tuple(_profile(members, tau, counts) for members in sets.values())


def stated_gains(rows: DriveRows, groups: Sequence[Group], delay: float) -> tuple[GainProfile, ...]:
    """Return the gains of joints with one stated kp, which a fit has taken as it is stated."""
    each = [
        replace(x, links=rows.links[:, x.joints].T.ravel(), more=(*x.more, "gain")) for x in groups
    ]
    return gain_profiles(rows, each, delay, by_group=False)


def with_gains(groups: Sequence[Group], profiles: Sequence[GainProfile]) -> tuple[Group, ...]:
    """Return the groups with the gains of profiles."""
    of = {joint: (one.gain, one.std) for one in profiles for joint in one.joints}
    return tuple(replace(group, gain=of[group.joints[0]]) for group in groups)


def _profile(groups: Sequence[Group], tau: Array, counts: Array) -> GainProfile:
    """Return the gain of groups with least loss, and the gains with hardly a larger one."""
    joints = tuple(joint for group in groups for joint in group.joints)

    def loss(log_gain: float) -> float:
        return sum(_loss(group, tau, counts, np.exp(-log_gain)) for group in groups)

    grid = np.linspace(-np.log(LARGEST), np.log(LARGEST), POINTS)
    losses, step = np.array([loss(x) for x in grid.tolist()]), grid[1] - grid[0]
    near = np.clip(grid[np.argmin(losses)] + np.array([-step, step]), grid[0], grid[-1])
    best = float(minimize_scalar(loss, bounds=near, method="bounded").x)
    above = losses - loss(best) - likelihood_drop()
    ends = []
    for side in (-1, 1):
        # Out from the best: the first point of the grid above the drop; infinite without one.
        beyond = np.flatnonzero((side * (grid - best) > 0.0) & (above > 0.0))[::side]
        ends.append(side * np.inf)
        if len(beyond):
            ends[-1] = brentq(
                lambda x: loss(x) - loss(best) - likelihood_drop(), best, grid[beyond[0]]
            )
    low, high = np.exp(ends).tolist()
    profile = GainProfile(joints, float(np.exp(best)), (low, high))
    return replace(profile, gain=1.0) if profile.is_open else profile


def _loss(group: Group, tau: Array, counts: Array, inverse: float) -> float:
    """Return twice the loss of log-likelihood of a group's joints at a value of 1 / gain."""
    assert group.links is not None
    b = tau[:, group.joints].T.ravel() - (inverse - 1.0) * group.links
    Q, R = group.factors
    x, _ = solve_bounded(R, Q.T @ b, group.nonnegative)
    # In units of the stated torque: a fit of torques over the gain would gain by their size alone.
    return group.loss(x, b, counts[list(group.joints)])
