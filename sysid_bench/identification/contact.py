"""Contact periods of a recording: declared by intervals, or found by what free motion cannot be.

Nothing but its own weight is to act behind a force/torque sensor. A contact that lasts adds a
wrench that no parameters explain: the samples are looked at in windows, and those that parameters
fitted to the quietest of them cannot foretell are left out.
"""

from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.types import Array

WINDOWS: Final = 100
"""Into how many parts a recording is cut: half a second of fifty."""

QUIET: Final = 0.5
"""Share of the windows that least trimmed squares trusts: contacts may fill nearly as much."""

ROUNDS: Final = 30
"""Refits at most; each makes the sum over the quietest windows smaller (Rousseeuw and van Driessen
2006, the C-step)."""

LIMIT: Final = 1.5
"""Largest mean square of a window's residuals, in units of the noise: that of 100 samples of six
rows has a deviation of 0.06 around one."""


def free_samples(W: Array, f: Array) -> Array:
    """Which samples (N,) of f (N, m) = W (N, m, r) beta + noise are free of contact.

    Raises EstimationError where the recording is too short, or where the quietest half of it does
    not excite every direction.
    """
    N, m, r = W.shape
    window = np.arange(N) * WINDOWS // max(N, 1)
    if N * m < 4 * r or N < 2 * WINDOWS:
        raise EstimationError(f"{N} samples are too few to find contacts in.")
    quiet = np.ones(WINDOWS, dtype=bool)
    sigma = np.sqrt((f**2).mean(axis=0))
    sigma = np.where(sigma > 0, sigma, 1.0)
    for _ in range(ROUNDS):
        beta = _fitted(W, f, sigma, quiet[window])
        residual = f - W @ beta
        sizes = _sizes(residual / sigma, window)
        chosen = np.argsort(sizes, kind="stable")[: int(QUIET * WINDOWS)]
        before, quiet = quiet, np.isin(np.arange(WINDOWS), chosen)
        sigma = np.sqrt((residual[quiet[window]] ** 2).mean(axis=0))
        sigma = np.where(sigma > 0, sigma, 1.0)
        if np.array_equal(before, quiet):
            break
    # The quietest half underrates the noise; the median window is a fair one.
    sizes = _sizes((f - W @ _fitted(W, f, sigma, quiet[window])) / sigma, window)
    level = np.median(sizes[np.argsort(sizes)[: int(0.6 * WINDOWS)]])
    return np.asarray((sizes <= LIMIT * level)[window])


def _fitted(W: Array, f: Array, sigma: Array, keep: Array) -> Array:
    r = W.shape[-1]
    G, g = (W[keep] / sigma[:, None]).reshape(-1, r), (f[keep] / sigma).ravel()
    beta, _, rank, _ = np.linalg.lstsq(G, g, rcond=1e-9)
    if rank < r:
        raise EstimationError(
            f"The quietest half of the recording excites {rank} of {r} base parameters: contacts "
            "cannot be found in it; declare their intervals."
        )
    return np.asarray(beta)


def _sizes(residual: Array, window: Array) -> Array:
    """Mean square (WINDOWS,) of the residuals (N, m) of each window."""
    total = np.bincount(window, weights=(residual**2).mean(axis=1), minlength=WINDOWS)
    return np.asarray(total / np.bincount(window, minlength=WINDOWS))
