"""Backlash apart from Coulomb friction: a gap changes sides with the load, friction with the speed.

Where a controller closes its loop before a gap of width w and positions are those behind it, its
torque has a step kp w / 2 sign(tau_links). Only loads beyond the friction press the gap to one
side, and only those of both signs separate the step from an offset."""

from typing import Final

import numpy as np

from sysid_bench.apps.actuators.bounded_fit import SIGNED, Group, block_covariance
from sysid_bench.apps.actuators.drive_estimate import DriveEstimate
from sysid_bench.types import Array

REVERSED: Final = 0.02
"""Least share of the moving rows with loads beyond friction of either sign."""

LEAST: Final = 0.05
"""Least load over its RMS whose sign counts: the smaller ones are errors of the links."""


def load_steps(found: DriveEstimate, kp: Array) -> tuple[Array, Array]:
    """Return half the step (k,) of the torque, in stated units, with the sign of the load, and its
    deviation, for stated gains `kp` (k,); NaN for joints whose load does not change its sign beyond
    friction and dead band."""
    rows, band = found.rows, found.rows.servo.get("dead-band", np.zeros(len(kp)))
    gain = found.other_values.get("gain", np.ones(len(kp)))
    step, std = np.full((2, len(kp)), np.nan)
    for j in range(len(kp)):
        load = rows.links[:, j]
        lost = float(found.fit.values[j, 2] + gain[j] * kp[j] * band[j])
        least = max(lost, LEAST * float(np.sqrt(np.mean(load**2))))
        moving = np.count_nonzero(rows.features[:, j, SIGNED])
        sides = [np.count_nonzero(side * load > least) for side in (-1.0, 1.0)]
        if least > 0.0 and moving and min(sides) >= REVERSED * moving:
            sign = rows.features[:, j, SIGNED] * np.tanh(load / least)
            values, covariance = _unbounded(found, j, sign[:, None])
            step[j], std[j] = values[-1], np.sqrt(covariance[-1, -1])
    return step, std


def friction_std(found: DriveEstimate) -> Array:
    """Return the deviations (k,) of the Coulomb friction; of one on its bound, that without it."""
    gain = found.other_values.get("gain", np.ones(len(found.rows.joints)))
    std = found.fit.std[:, 2].copy()
    for j in np.flatnonzero(found.fit.at_bound[:, 2]):
        covariance = _unbounded(found, int(j), np.zeros((len(found.rows.links), 0)))[1]
        std[j] = gain[j] * np.sqrt(covariance[2, 2])
    return std


def _unbounded(found: DriveEstimate, j: int, more: Array) -> tuple[Array, Array]:
    """Return values (c,) of a joint without bounds, those of `more` columns (N, e) at last, and
    their covariance (c, c), in stated units."""
    rows = found.rows
    columns = [*range(SIGNED + 1)]
    columns += [SIGNED + 1 + i for i, name in enumerate(rows.more) if name != "gain"]
    A = np.hstack([rows.features[:, j, columns], more])
    gain = found.other_values.get("gain", np.ones(len(rows.joints)))[j]
    b = rows.torque(found.delay)[:, j] + (1.0 - 1.0 / gain) * rows.links[:, j]
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    every = np.arange(A.shape[1])
    return x, block_covariance(Group((j,), A), b - A @ x, every, rows.rate)
