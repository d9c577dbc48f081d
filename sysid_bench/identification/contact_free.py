"""Contact detection in recordings of a force/torque sensor, by least trimmed squares.

Without contact, only the weight and inertia of the distal bodies act on the sensor. A lasting
contact adds a wrench that no parameters explain. The samples are divided into windows, and windows
that a fit to the quietest ones does not predict are rejected.
"""

from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.qr_factor import qr_factor
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
    unknown = np.where(keep, 0.0, leverage.reshape(f.shape).mean(axis=1))
    return _by_window(squares.mean(axis=1), window) / (1.0 + _by_window(unknown, window))


def _by_window(values: Array, window: Array) -> Array:
    """Means (WINDOWS,) of values (N,)."""
    total = np.bincount(window, weights=values, minlength=WINDOWS)
    return np.asarray(total / np.bincount(window, minlength=WINDOWS))


def _fitted(W: Array, f: Array, keep: Array) -> tuple[Array, Array]:
    """Least squares beta (r,) with rows weighted by their own noise (as `wls`), and the noise (m,)
    of its residuals."""
    rows, r = range(f.shape[1]), W.shape[-1]
    sigma = _positive(np.array([_own_noise(W[keep, i], f[keep, i]) for i in rows]))
    G, g = (W[keep] / sigma[:, None]).reshape(-1, r), (f[keep] / sigma).ravel()
    beta, _, rank, _ = np.linalg.lstsq(G, g, rcond=1e-9)
    if rank < r:
        raise EstimationError(
            f"The quietest part of the recording excites {rank} of {r} base parameters, too few "
            "for contact detection; declare the contact intervals."
        )
    left = np.sqrt(((f[keep] - W[keep] @ beta) ** 2).mean(axis=0))
    return np.asarray(beta), _positive(left * np.sqrt(len(g) / max(len(g) - r, 1)))


def _own_noise(W: Array, f: Array) -> float:
    beta, _, rank, _ = np.linalg.lstsq(W, f, rcond=1e-9)
    return float(np.linalg.norm(f - W @ beta) / np.sqrt(max(len(f) - rank, 1)))


def _positive(sigma: Array) -> Array:
    return np.where(sigma > 0, sigma, 1.0)
