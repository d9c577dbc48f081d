"""Cramer-Rao bounds: the smallest covariance that any unbiased estimator can have.

W (n, rows, r) is the base regressor along the true motion, C the covariance of the torque noise.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.identification.linear.normal_qr import excited_rank, stacked_factor
from sysid_bench.qr_factor import upper_factor
from sysid_bench.types import Array, Problem


def white_bound(exact: Problem, std: Array) -> Array | None:
    """Return the bound (r, r) for torque noise that is white and independent on every row, with
    standard deviations `std` (rows,); None if the motion does not excite all base parameters.

    `exact` is the problem of the true, noise-free motion.
    """
    return _inverse(stacked_factor(exact, (1 / std).tolist())[:-1, :-1])


def torque_bound(
    rows: Iterable[Array], covariance: Array, correlation: float = 0.0
) -> Array | None:
    """Return the bound (r, r) for noise in torque alone, (sum_k W_k' C^-1 W_k)^-1 by QR; None if
    the motion does not excite all base parameters.

    `rows` are blocks of W (n, rows, r), `covariance` is C (rows, rows). The noise is white in time,
    or a first-order autoregression with this `correlation` of consecutive samples.
    """
    # QR of the whitened rows, block by block: the information W' C^-1 W itself would have the
    # squared condition number.
    L = np.linalg.cholesky(covariance)
    blocks = rows if correlation == 0.0 else _whitened(rows, correlation)
    R = np.zeros((0, 0))
    for block in blocks:
        # L^-1 W has unit noise on every row.
        white = np.linalg.solve(L, block).reshape(-1, block.shape[2])
        R = upper_factor([R.reshape(-1, block.shape[2]), white])
    return _inverse(R)


def _inverse(R: Array) -> Array | None:
    """(R'R)^-1, or None if R is singular."""
    if len(R) == 0 or excited_rank(R) < R.shape[1]:
        return None
    inverse = solve_triangular(R, np.eye(len(R)))
    return np.asarray(inverse @ inverse.T)


def _whitened(rows: Iterable[Array], correlation: float) -> Iterator[Array]:
    """Rows with independent noise in every sample: W_0, then (W_t - c W_(t-1)) / sqrt(1 - c^2)."""
    last = None  # sample of the block before
    for block in rows:
        previous = block[:1] if last is None else last
        whitened = block - correlation * np.concatenate([previous, block[:-1]])
        whitened /= np.sqrt(1 - correlation**2)
        # The first sample has no predecessor, and the full variance of the process.
        if last is None:
            whitened[0] = block[0]
        last = block[-1:]
        yield whitened
