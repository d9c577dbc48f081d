"""Separation of the delay from armature and damping.

An assumed delay that is d too long lowers the torque by about d (kp v + kd a): what that differs
from armature and damping alone separates them, and model errors of that size hide it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED, Fit, Group
from sysid_bench.apps.actuators.drive_rows import DriveRows
from sysid_bench.types import Array

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
        x = np.linalg.lstsq(group.A, c, rcond=None)[0]
        rest = c - group.A @ x
        for i, j in enumerate(group.joints):
            direction[j] = x[group.columns(i)[: SIGNED + 1]]
            left[:, j] = rest[i * group.samples : (i + 1) * group.samples]
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
