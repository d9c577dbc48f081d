"""Identification of actuators: fit, profile over the delay, and what cannot be separated."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.actuators.bounded_fit import Fit, bounded_fit, groups_of
from sysid_bench.actuators.confounding import Separation, separation
from sysid_bench.actuators.delay_profile import DelayProfile, delay_grid, delay_profile
from sysid_bench.actuators.drive_rows import DriveRows
from sysid_bench.actuators.rollout import Drives
from sysid_bench.types import Array

NORMAL: Final = 1.96
"""97.5 % quantile of the normal distribution."""


@dataclass(frozen=True, eq=False)
class Identified:
    """Actuators of the joints of `rows`: the fit at the `delay` (s); where that was unknown, its
    profile, and how far it is separated from armature and damping."""

    rows: DriveRows
    fit: Fit
    delay: float
    profile: DelayProfile | None = None
    separation: Separation | None = None

    @property
    def drives(self) -> Drives:
        """The actuators as a simulation takes them."""
        return Drives(self.rows.joints, self.fit.values, self.delay)

    @property
    def std(self) -> Array:
        """Standard deviations (k, 4) in the order of UNKNOWNS, with that of an unknown delay; zero
        on a bound."""
        if self.profile is None or self.separation is None:
            return self.fit.std
        low, high = self.profile.interval
        moved = self.separation.direction * (high - low) / (2.0 * NORMAL)
        return np.where(self.fit.at_bound, 0.0, np.hypot(self.fit.std, moved))


def identify_drives(
    rows: DriveRows,
    shared: Sequence[str] = (),
    delay: float | None = None,
    delays: Array | None = None,
) -> Identified:
    """Return the actuators: at a known delay (s), or with the one that fits best.

    `shared`: words; joints whose names hold the same one have equal armature and friction.
    `delays` (s): the best is one of them; None: it may lie between those of `delay_grid`.
    """
    groups = groups_of(rows, shared)
    if delay is not None:
        return Identified(rows, bounded_fit(groups, rows.torque(delay), rows.rate), delay)
    grid = delay_grid(rows.rate) if delays is None else delays
    profile = delay_profile(rows, groups, grid, between=delays is None)
    fit = bounded_fit(groups, rows.torque(profile.best), rows.rate)
    apart = separation(rows, groups, profile.best, fit)
    return Identified(rows, fit, profile.best, profile, apart)
