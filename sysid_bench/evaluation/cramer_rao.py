"""Cramer-Rao bounds: the smallest covariance that any unbiased estimator can have.

W (n, rows, r) is the base regressor along the true motion, C the covariance of the torque noise.
"""

from collections.abc import Iterable, Iterator

import numpy as np
import scipy.linalg
from scipy.linalg import solve_triangular

from sysid_bench.identification.linear.least_squares import data_rank, stacked_factor
from sysid_bench.numerics import qr_factor
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
        R = qr_factor([R.reshape(-1, block.shape[2]), white])
    return _inverse(R)


def _inverse(R: Array) -> Array | None:
    """(R'R)^-1, or None if R is singular."""
    if len(R) == 0 or data_rank(R) < R.shape[1]:
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


def encoder_bound(
    rows: Array, slopes: tuple[Array, Array, Array], step: float, q_std: Array, tau_std: Array
) -> Array | None:
    """Return the bound (r, r) for white noise of encoders and torque sensors, errors in variables:
    (W' (S_tau + J S_q J')^-1 W)^-1; None if the motion does not excite all base parameters.

    `rows` are W (N, rows, r) along the true motion, `slopes` the derivatives (N, rows, n) of the
    torque by q, v and a, `step` (s) the sampling period, `q_std` (n,) and `tau_std` (rows,) the
    deviations. Each sample of q is an unknown of its own, v and a are its central differences, so
    that J = d tau / d q + d tau / d v D1 + d tau / d a D2 with the matrices D1, D2 of differences:
    the information about (q, beta) with q eliminated (Fuller 1987, chapter 3, to first order in the
    noise). A method that knows the motion to be smooth may fall below it; with S_q = 0 it is
    `torque_bound` of all samples but the first and the last.
    """
    dq, dv, da = slopes
    # Column blocks of J: the torque of sample k by the noise of q at k - 1, k and k + 1.
    before, now, after = (
        block[1:-1] * q_std
        for block in (
            -dv / (2 * step) + da / step**2,
            dq - 2 * da / step**2,
            dv / (2 * step) + da / step**2,
        )
    )
    # The lower bands (3 rows, N rows) of S_tau + J S_q J', from the blocks (N, rows, n) of J
    noise = np.diag(tau_std**2)
    N, m = now.shape[:2]
    turned = [np.swapaxes(block, 1, 2) for block in (before, now, after)]
    own = noise + before @ turned[0] + now @ turned[1] + after @ turned[2]
    # Of sample k + 1, then k + 2 (rows) with sample k (columns): they share two, then one, of q.
    next_one = np.zeros((N, m, m))
    next_one[:-1] = before[1:] @ turned[1][:-1] + now[1:] @ turned[2][:-1]
    next_two = np.zeros((N, m, m))
    next_two[:-2] = before[2:] @ turned[2][:-2]
    columns = np.concatenate([own, next_one, next_two], axis=1)  # (N, 3 m, m)
    bands = np.zeros((3 * m, N * m))
    for i in range(m):
        bands[: 3 * m - i, i::m] = columns[:, i:, i].T
    W, C = rows[1:-1], bands
    L = scipy.linalg.cholesky_banded(C, lower=True)
    flat = W.reshape(-1, W.shape[2])
    white, _ = scipy.linalg.lapack.dtbtrs(L, flat, uplo="L")
    return _inverse(qr_factor([white]))
