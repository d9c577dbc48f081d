"""The Cramer-Rao bound: how sure any unbiased method could be, and how near one comes to it."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.identification.linear.normal_qr import excited_rank, stacked_factor
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.types import Array, Problem


def white_bound(exact: Problem, std: Array) -> Array | None:
    """The bound (r, r) where torque alone is noisy, white and apart on every row with deviations
    (rows,); None where the motion does not excite every direction. `exact`: of the true motion."""
    return _inverse(stacked_factor(exact, (1 / std).tolist())[:-1, :-1])


def torque_bound(
    rows: Iterable[Array], covariance: Array, correlation: float = 0.0
) -> Array | None:
    """The bound (r, r) where torque alone is noisy: (sum W_k' C^-1 W_k)^-1 along the true motion,
    by QR; None where the motion does not excite every direction.

    `rows`: blocks of the base regressor (n, rows, r) of the exact motion; `covariance` (rows, rows)
    of the torque noise, which is white in time or has a `correlation` from sample to sample.
    """
    half = np.linalg.cholesky(covariance)
    blocks = rows if correlation == 0.0 else _whitened(rows, correlation)
    R = np.zeros((0, 0))
    for block in blocks:
        # Columns of L^-1 W: unit noise on every row.
        white = np.linalg.solve(half, block).reshape(-1, block.shape[2])
        R = upper_factor([R.reshape(-1, block.shape[2]), white])
    return _inverse(R)


def _inverse(R: Array) -> Array | None:
    """(R'R)^-1, where R has an inverse."""
    if len(R) == 0 or excited_rank(R) < R.shape[1]:
        return None
    inverse = solve_triangular(R, np.eye(len(R)))
    return np.asarray(inverse @ inverse.T)


def _whitened(rows: Iterable[Array], correlation: float) -> Iterator[Array]:
    """Rows whose noise is new in every sample: the first as it is, then (W_t - c W_(t-1)) / sqrt(1
    - c^2)."""
    before = None
    for block in rows:
        last = block[:1] if before is None else before
        fresh = block - correlation * np.concatenate([last, block[:-1]])
        fresh /= np.sqrt(1 - correlation**2)
        if before is None:
            fresh[0] = block[0]
        before = block[-1:]
        yield fresh


def trajectory_bound(
    rows: Iterable[Array], slopes: Iterable[Array], torque: Array, motion: Array
) -> Array:
    """The bound (r, r) where the motion is unknown too: (sum W_k' (C + G_k M G_k')^-1 W_k)^-1.

    Each sample's (q, v, a) is a nuisance, measured with the covariance `motion` (3 nv, 3 nv) and
    eliminated by linearisation; `slopes`: blocks G (n, rows, 3 nv) of the derivatives of the torque
    by (q, v, a) along the true motion. Errors of different samples are taken as independent, so
    that derivatives made by a filter from the same q are more certain than this says.
    """
    total: Array = np.zeros(())
    for W, G in zip(rows, slopes, strict=True):
        noise = torque + G @ motion @ G.swapaxes(1, 2)
        total = total + np.einsum("nir,nis->rs", W, np.linalg.solve(noise, W))
    return np.linalg.inv(total)


def coverage(low: Array, high: Array, truth: Array) -> tuple[float, float]:
    """(share, standard error) of intervals (n, r) that hold the truth (r,), over all parameters;
    parameters of one repeat share their noise, so that repeats alone count for the error."""
    held = ((low <= truth) & (truth <= high)).mean(axis=1)
    spread = held.std(ddof=1) / np.sqrt(len(held)) if len(held) > 1 else np.nan
    return float(held.mean()), float(spread)
