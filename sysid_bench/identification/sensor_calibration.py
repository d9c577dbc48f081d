"""In-situ calibration of a force/torque sensor: gain, crosstalk, mounting and offset.

With a known load the true wrench f = Y_n phi is known, and the sensor reads G f + o with one matrix
G (6, 6). Readings are noisy and models are not: readings are regressed on models and the result is
inverted, since the reverse regression would be biased.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.types import Array

SPREAD: Final = 0.02
"""Prior standard deviation of the entries of G - 1, relative to the size of their rows and columns.
One load excites little besides c x f: the unexcited entries keep their prior mean."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Sensor model: reading = G f + offset, [n; f] in N m and N."""

    G: Array  # (6, 6)
    offset: Array  # (6,)

    def apply(self, reading: Array) -> Array:
        """Return the wrench (N, 6) of a reading (N, 6)."""
        return np.linalg.solve(self.G, (reading - self.offset).T).T


def fit_calibration(reading: Array, known: Array, spread: float = SPREAD) -> Calibration:
    """Estimate the calibration from readings (N, 6) of known wrenches (N, 6), of one load or
    several.

    Maximum a posteriori, row by row: G - 1 has a normal prior with standard deviation `spread`, the
    noise is the residual of the unconstrained fit. Raises EstimationError for too few samples or
    zero wrenches.
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
    # The offset has no prior.
    information = np.diag([spread**-2] * 6 + [0.0])
    posterior = np.array(
        [np.linalg.solve(H + s**2 * information, z[:, i]) for i, s in enumerate(sigma)]
    )
    return Calibration(np.eye(6) + posterior[:, :6] * size[:, None] / size, posterior[:, 6] * size)
