"""In-situ calibration of a force/torque sensor: gain, crosstalk, mounting and constants at once.

With a known load the true wrench is known, f = Y_n phi, and a sensor reads G f + o with one matrix
G (6, 6), whatever its errors are made of. Readings are noisy and models are not, so that readings
are regressed on models and the result is inverted: the other way round would be biased.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.types import Array

SPREAD: Final = 0.02
"""What is believed of a sensor beforehand: entries of G within 2 % of the ideal (one deviation), by
the size of their rows and columns. One load moves little but c x f: what it does not tell stays."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A sensor that reads G f + offset."""

    G: Array  # (6, 6)
    offset: Array  # (6,)

    def apply(self, reading: Array) -> Array:
        """The wrench (N, 6) behind a reading (N, 6)."""
        return np.linalg.solve(self.G, (reading - self.offset).T).T


def calibrate(reading: Array, known: Array, spread: float = SPREAD) -> Calibration:
    """The calibration of readings (N, 6) of known wrenches (N, 6), of one load or of several one
    after another. G is found as near to the ideal as the readings let it, row by row: a normal
    prior with deviations `spread` against the noise that the best fit leaves.

    Raises EstimationError where there are too few samples, or no wrench at all.
    """
    if len(known) < 50 or not np.abs(known).max() > 0:
        raise EstimationError(
            f"{len(known)} samples of known wrenches up to {np.abs(known).max(initial=0.0):.1e} "
            "cannot calibrate a sensor: record a motion with a load that weighs something."
        )
    size = np.repeat([np.sqrt((known[:, part] ** 2).mean()) for part in (slice(3), slice(3, 6))], 3)
    scaled = np.hstack([known / size, np.ones((len(known), 1))])
    residual = (reading - known) / size  # of G - 1 in units of the spread, and of the constants
    free = np.linalg.lstsq(scaled, residual, rcond=None)[0]
    sigma = np.sqrt(((residual - scaled @ free) ** 2).mean(axis=0))
    H, z = scaled.T @ scaled, scaled.T @ residual
    believed = np.diag([spread**-2] * 6 + [0.0])
    told = np.array([np.linalg.solve(H + s**2 * believed, z[:, i]) for i, s in enumerate(sigma)])
    return Calibration(np.eye(6) + told[:, :6] * size[:, None] / size, told[:, 6] * size)
