"""Identification of actuators: fit, profile over the delay, what cannot be separated, and ranges of
parameters from the scatter between repeated recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import (
    Fit,
    Group,
    bounded_fit,
    group_joints,
    independent_samples,
)
from sysid_bench.apps.actuators.delay_profile import (
    MOST,
    DelayInformation,
    DelayProfile,
    delay_grid,
    delay_information,
    delay_profile,
)
from sysid_bench.apps.actuators.drive_rows import DriveRows
from sysid_bench.apps.actuators.gain_profile import GainProfile, gain_profiles, with_gains
from sysid_bench.apps.actuators.rollout import Drives
from sysid_bench.evaluation.intervals import coverage_factor
from sysid_bench.types import Array

ROUNDS: Final = 3
"""Times that the links' torque is computed at the bias found before."""


@dataclass(frozen=True, eq=False)
class DriveEstimate:
    """Actuators of the joints of `rows` in `groups` that share values: the fit at the `delay` (s);
    where that was unknown, its profile, and how far it is separated from armature and damping;
    where gains were unknown, their profiles."""

    rows: DriveRows
    groups: tuple[Group, ...]
    fit: Fit
    delay: float
    profile: DelayProfile | None = None
    separation: DelayInformation | None = None
    gains: tuple[GainProfile, ...] = ()

    @property
    def drives(self) -> Drives:
        """The actuators as a simulation takes them."""
        return Drives(self.rows.joints, self.fit.values, self.delay, self.other_values)

    @property
    def other_values(self) -> dict[str, Array]:
        """Values (k,) of further unknowns, and of the limits of the controllers, by name."""
        found = {**self.rows.servo, **dict(zip(self.rows.more, self.fit.more.T, strict=True))}
        if "bias" in found and self.rows.bias is not None:
            found["bias"] = found["bias"] + self.rows.bias
        return found

    @property
    def parameters(self) -> int:
        """Number of values: those that joints share count once."""
        return sum(int(group.A.shape[1]) for group in self.groups) + len(self.gains)

    @property
    def rank(self) -> int:
        """Number of values that are not on their bound."""
        return self.parameters - sum(
            int(self.fit.at_bound[group.joints[0]].sum()) for group in self.groups
        )

    @property
    def std(self) -> Array:
        """Standard deviations (k, 4) in the order of UNKNOWNS, with that of an unknown delay; NaN
        on a bound, where a value is not an estimate.

        The delay's deviation is that of its profile, which holds for an exact model; where delay
        and armature are confounded, it is at least what the residuals leave open.
        """
        moved = self._delay_std * (0.0 if self.separation is None else self.separation.direction)
        return np.where(self.fit.at_bound, np.nan, np.hypot(self.fit.std, moved))

    @property
    def covariance(self) -> Array:
        """Covariance (k, 5, 5) of each joint's values, as UNKNOWNS, and of the delay."""
        k, each = self.fit.values.shape
        whole = np.zeros((k, each + 1, each + 1))
        whole[:, :each, :each] = self.fit.covariance[:, :each, :each]
        moved = np.zeros((k, each + 1))
        if self.separation is not None:
            moved[:, :each] = np.where(self.fit.at_bound, 0.0, self.separation.direction)
        # Too small an armature with too long a delay fits nearly as well, either alone does not:
        # whoever draws them needs their covariance.
        moved[:, each] = 1.0
        return np.asarray(whole + self._delay_std**2 * np.einsum("ki,kj->kij", moved, moved))

    @property
    def _delay_std(self) -> float:
        """Standard deviation (s) of the delay; zero where it is stated, or has no effect."""
        if self.profile is None or self.separation is None or self.separation.is_static:
            return 0.0
        low, high = self.profile.interval
        # Rounded as in `likelihood_drop`: both stand for one quantile.
        of_profile = (high - low) / (2.0 * round(coverage_factor(np.inf), 2))
        apart = self.separation
        if not apart.is_open:
            return of_profile
        # Armatures of tables determine the delay, as far as the data trade one for the other.
        tables = np.zeros(0) if self.rows.armature is None else self.rows.armature[1]
        information = np.nansum((apart.direction[: len(tables), 0] / tables) ** 2)
        return max(of_profile, 1.0 / float(np.hypot(1.0 / apart.open, np.sqrt(information))))


def identify_drives(
    rows: DriveRows,
    shared: Sequence[str] = (),
    delay: float | None = None,
    delays: Array | None = None,
) -> DriveEstimate:
    """Return the actuators: at a known delay (s), or with the one that fits best.

    `shared`: words; joints whose names hold the same one have equal armature and friction.
    `delays` (s): the best is one of them; None: it may lie between those of `delay_grid`.
    """
    groups = group_joints(rows, shared)
    if "gain" not in rows.more:
        return _identify(rows, groups, delay, delays)
    # A delay moves the torque of commands, and hardly that of the links, which decides on gains:
    # each is found at the other one, and once more.

    def with_gains_at(start: float) -> DriveEstimate:
        gains = gain_profiles(rows, groups, start, by_group=bool(shared))
        return replace(_identify(rows, with_gains(groups, gains), delay, delays), gains=gains)

    first = with_gains_at(delay or 0.0)
    return first if delay is not None or first.delay == 0.0 else with_gains_at(first.delay)


def _identify(
    rows: DriveRows, groups: tuple[Group, ...], delay: float | None, delays: Array | None
) -> DriveEstimate:
    """Return the actuators of groups, whose gains are known."""
    if delay is not None:
        fit = bounded_fit(groups, rows.torque(delay), rows.rate)
        if rows.armature is not None:
            fit = bounded_fit(groups, rows.torque(delay), rows.rate, _scale(rows, fit))
        return DriveEstimate(rows, groups, fit, delay)
    grid = delay_grid(rows.rate) if delays is None else delays
    profile, scale = delay_profile(rows, groups, grid, between=delays is None), None
    while delays is None and profile.on_edge and grid[-1] < MOST:
        grid = delay_grid(rows.rate, 2.0 * float(grid[-1]))
        profile = delay_profile(rows, groups, grid)
    if rows.armature is not None:
        # How much a table weighs beside the data depends on the residuals, which a first fit
        # without tables gives.
        scale = _scale(rows, bounded_fit(groups, rows.torque(profile.best), rows.rate))
        profile = delay_profile(rows, groups, grid, between=delays is None, scale=scale)
    fit = bounded_fit(groups, rows.torque(profile.best), rows.rate, scale)
    apart = delay_information(rows, groups, profile.best, fit)
    return DriveEstimate(rows, groups, fit, profile.best, profile, apart)


def _scale(rows: DriveRows, fit: Fit) -> Array:
    """Return the deviation (k,) of a row that would be independent of the others: residuals are
    correlated, and their rows count as fewer."""
    counts = independent_samples(fit.residuals, rows.rate)
    return np.asarray(fit.errors * np.sqrt(len(fit.residuals) / counts))


def identify_recordings(
    rows_at: Callable[[Array | None], DriveRows],
    shared: Sequence[str] = (),
    delay: float | None = None,
) -> DriveEstimate:
    """Return the actuators from rows at a bias of the positions (k,; None: zero). Where the bias is
    unknown, the torque of the links is computed again at the one found, ROUNDS times."""
    found = identify_drives(rows_at(None), shared, delay)
    if "bias" not in found.rows.more:
        return found
    for _ in range(ROUNDS):
        # Gravity is not linear in the bias: the column is its slope at the last one.
        found = identify_drives(rows_at(found.other_values["bias"]), shared, delay)
    return found


def repeat_covariance(values: Array, delays: Array) -> Array:
    """Return the covariance (k, c + 1, c + 1) between n files of each joint's values (n, k, c) and
    of the delays (n,)."""
    # Residuals of one recording know nothing of what changes until the next: between five runs of
    # one quadruped values scattered 2 to 5 times as far as textbook deviations say.
    whole = np.concatenate(
        [values, np.tile(delays[:, None, None], (1, values.shape[1], 1))], axis=2
    )
    centred = whole - whole.mean(axis=0)
    return np.asarray(np.einsum("nki,nkj->kij", centred, centred) / (len(values) - 1))
