"""Force/torque sensors in situ: contact detection, and calibration with a known load.

Without contact, only the weight and inertia of the distal bodies act on the sensor. A lasting
contact adds a wrench that no parameters explain. The samples are divided into windows, and windows
that a fit to the quietest ones does not predict are rejected (least trimmed squares).

With a known load the true wrench f = Y_n phi is known, and the sensor reads G f + o with one matrix
G (6, 6): gain, crosstalk and mounting. Readings are noisy and models are not: readings are
regressed on models and the result is inverted, since the reverse regression would be biased."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.numerics import qr_factor
from sysid_bench.types import Array

WINDOWS: Final = 100
"""Windows of a recording: half a second each in a recording of fifty seconds."""

QUIET: Final = 0.5
"""Share of the windows that least trimmed squares fits; contacts may fill nearly the rest."""

ROUNDS: Final = 30
"""Most concentration steps (C-steps); each reduces the trimmed sum of squares (Rousseeuw and van
Driessen 2006)."""

LIMIT: Final = 4.0
"""Largest mean square of a free window's residuals, in units of the noise variance. It may exceed
one, since the noise of a distal sensor acts through a changing lever arm."""


def free_samples(W: Array, f: Array) -> Array:
    """Return which samples (N,) of f (N, m) = W (N, m, r) beta + noise are free of contact.

    Least trimmed squares on the quietest half of the windows; then all windows that its fit
    predicts are added, and the fit is repeated until none changes. Raises EstimationError where the
    recording is too short or its quietest half does not excite every direction.
    """
    N, m, r = W.shape
    if N * m < 4 * r or N < 2 * WINDOWS:
        raise EstimationError(f"{N} samples are too few for contact detection.")
    # Windows, not samples: contacts last, and a window's mean has little noise.
    window = np.arange(N) * WINDOWS // N
    kept = np.ones(WINDOWS, dtype=bool)
    for _ in range(ROUNDS):
        sizes = _sizes(W, f, kept, window)
        chosen = np.argsort(sizes, kind="stable")[: int(QUIET * WINDOWS)]
        before, kept = kept, np.isin(np.arange(WINDOWS), chosen)
        if np.array_equal(before, kept):
            break
    for _ in range(ROUNDS):
        before, kept = kept, _sizes(W, f, kept, window) <= LIMIT
        if np.array_equal(before, kept):
            break
    return np.asarray(kept[window])


def _sizes(W: Array, f: Array, kept: Array, window: Array) -> Array:
    """Mean square (WINDOWS,) of each window's residuals, relative to its expectation: the noise
    variance, plus the variance of the prediction in windows that the fit does not use."""
    keep = kept[window]
    beta, sigma = _fitted(W, f, keep)
    squares = ((f - W @ beta) / sigma) ** 2
    G = W / sigma[:, None]
    R = qr_factor([G[keep].reshape(-1, W.shape[-1])])
    leverage = (np.linalg.solve(R.T, G.reshape(-1, len(R)).T) ** 2).sum(axis=0)
    # Without this variance, windows that excite what the fit hardly knows would never return.
    unknown = np.where(keep, 0.0, leverage.reshape(f.shape).mean(axis=1))
    return _by_window(squares.mean(axis=1), window) / (1.0 + _by_window(unknown, window))


def _by_window(values: Array, window: Array) -> Array:
    """Means (WINDOWS,) of values (N,)."""
    total = np.bincount(window, weights=values, minlength=WINDOWS)
    return np.asarray(total / np.bincount(window, minlength=WINDOWS))


def _fitted(W: Array, f: Array, keep: Array) -> tuple[Array, Array]:
    """Least squares beta (r,) with rows weighted by their own noise (as `wls`), and the noise (m,)
    of its residuals."""
    r, own = W.shape[-1], []
    for i in range(f.shape[1]):  # the noise of each row in its own fit
        beta, _, rank, _ = np.linalg.lstsq(W[keep, i], f[keep, i], rcond=1e-9)
        left = np.linalg.norm(f[keep, i] - W[keep, i] @ beta)
        own.append(float(left / np.sqrt(max(int(keep.sum()) - rank, 1))))
    sigma = _positive(np.array(own))
    G, g = (W[keep] / sigma[:, None]).reshape(-1, r), (f[keep] / sigma).ravel()
    beta, _, rank, _ = np.linalg.lstsq(G, g, rcond=1e-9)
    if rank < r:
        raise EstimationError(
            f"The quietest part of the recording excites {rank} of {r} base parameters, too few "
            "for contact detection; declare the contact intervals."
        )
    left = np.sqrt(((f[keep] - W[keep] @ beta) ** 2).mean(axis=0))
    return np.asarray(beta), _positive(left * np.sqrt(len(g) / max(len(g) - r, 1)))


def _positive(sigma: Array) -> Array:
    return np.where(sigma > 0, sigma, 1.0)


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
    # Forces and moments by their own RMS: one spread then means the same for every entry of G.
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
