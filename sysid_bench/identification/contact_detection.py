"""Contact periods of a recording: declared by intervals, or found by what free motion cannot be.

Nothing but its own weight is to act behind a force/torque sensor. A contact that lasts adds a
wrench that no parameters explain: the samples are looked at in windows, and those that parameters
fitted to the quietest of them cannot foretell are left out.
"""

from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.recursive_qr import upper_factor
from sysid_bench.types import Array

WINDOWS: Final = 100
"""Into how many parts a recording is cut: half a second of fifty."""

QUIET: Final = 0.5
"""Share of the windows that least trimmed squares trusts: contacts may fill nearly as much."""

ROUNDS: Final = 30
"""Refits at most; each makes the sum over the quietest windows smaller (Rousseeuw and van Driessen
2006, the C-step)."""

LIMIT: Final = 4.0
"""Largest mean square of a window's residuals, in units of the noise. Free windows may lie above
one: the noise of a sensor that ends a sub-tree arrives with a lever that changes."""


def free_samples(W: Array, f: Array) -> Array:
    """Which samples (N,) of f (N, m) = W (N, m, r) beta + noise are free of contact.

    Least trimmed squares on the quietest half of the windows; then all that its fit foretells join
    it, as long as any do. Raises EstimationError where the recording is too short, or where the
    quietest half of it does not excite every direction.
    """
    N, m, r = W.shape
    if N * m < 4 * r or N < 2 * WINDOWS:
        raise EstimationError(f"{N} samples are too few to find contacts in.")
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
    """Mean square (WINDOWS,) of the residuals of each window, over what noise makes of it: that of
    the windows that are kept, whose fit it is, and in others what this fit does not know yet."""
    keep = kept[window]
    beta, sigma = _fitted(W, f, keep)
    squares = ((f - W @ beta) / sigma) ** 2
    G = W / sigma[:, None]
    R = upper_factor(G[keep].reshape(-1, W.shape[-1]))
    leverage = (np.linalg.solve(R.T, G.reshape(-1, len(R)).T) ** 2).sum(axis=0)
    unknown = np.where(keep, 0.0, leverage.reshape(f.shape).mean(axis=1))
    return _by_window(squares.mean(axis=1), window) / (1.0 + _by_window(unknown, window))


def _by_window(values: Array, window: Array) -> Array:
    """Means (WINDOWS,) of values (N,)."""
    total = np.bincount(window, weights=values, minlength=WINDOWS)
    return np.asarray(total / np.bincount(window, minlength=WINDOWS))


def _fitted(W: Array, f: Array, keep: Array) -> tuple[Array, Array]:
    """Least squares (r,), rows weighted by the noise that a fit of each alone leaves (as `wls`),
    and the noise (m,) that the residuals of all together tell."""
    rows, r = range(f.shape[1]), W.shape[-1]
    sigma = _positive(np.array([_own_noise(W[keep, i], f[keep, i]) for i in rows]))
    G, g = (W[keep] / sigma[:, None]).reshape(-1, r), (f[keep] / sigma).ravel()
    beta, _, rank, _ = np.linalg.lstsq(G, g, rcond=1e-9)
    if rank < r:
        raise EstimationError(
            f"The quietest part of the recording excites {rank} of {r} base parameters: contacts "
            "cannot be found in it; declare their intervals."
        )
    left = np.sqrt(((f[keep] - W[keep] @ beta) ** 2).mean(axis=0))
    return np.asarray(beta), _positive(left * np.sqrt(len(g) / max(len(g) - r, 1)))


def _own_noise(W: Array, f: Array) -> float:
    beta, _, rank, _ = np.linalg.lstsq(W, f, rcond=1e-9)
    return float(np.linalg.norm(f - W @ beta)) / np.sqrt(max(len(f) - rank, 1))


def _positive(sigma: Array) -> Array:
    return np.where(sigma > 0, sigma, 1.0)
