"""Least squares from the R factors of a problem, and the noise that weighs its rows.

R factors are normal equations in square-root form. The noise of each joint's torque is taken from
residuals, or from the size of the torque."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.linalg import lapack, solve_triangular

from sysid_bench.errors import EstimationError, unknown_name
from sysid_bench.types import Array, Factor, Problem

EXCITED: Final = 1e-9
"""Excitation threshold: directions with a smaller singular value (unit columns, relative to the
largest) contain rounding error alone."""


def stacked_factor(problem: Problem, weights: Sequence[float] | None = None) -> Array:
    """R (r + 1, r + 1) of [W | b], each row of the robot times its weight."""
    r = problem.base.rank
    scales = [1.0] * len(problem.factors) if weights is None else weights
    # R of stacked R factors is R of the stacked rows, whose Q cancel: no sample is read again, and
    # normal equations, which square the condition number, never appear.
    parts = [
        scale * spread(factor, r) for factor, scale in zip(problem.factors, scales, strict=True)
    ]
    # The zeros make R square where the factors have fewer rows than columns.
    stack = np.asfortranarray(np.concatenate([*parts, np.zeros((r + 1, r + 1))]))
    packed, _, _, _ = lapack.dgeqrf(stack, lwork=64 * (r + 1), overwrite_a=1)
    return np.triu(packed[: r + 1])


def spread(factor: Factor, r: int) -> Array:
    """Rows (m, r + 1) of a factor, its columns at their indices among all base parameters."""
    wide = np.zeros((len(factor.R), r + 1))
    wide[:, factor.columns] = factor.R[:, :-1]
    wide[:, r] = factor.R[:, -1]
    return wide


def solve(R: Array) -> Array:
    """Return beta (r,) = argmin |R [beta; -1]|; raises EstimationError for a rank-deficient R."""
    check_rank(R)
    return solve_factor(R)


def check_rank(R: Array) -> None:
    """Raise EstimationError where the data do not excite every base parameter."""
    r = R.shape[1] - 1
    rank = data_rank(R[:r, :r])
    if rank < r:
        raise EstimationError(
            f"The motion excites {rank} of {r} base parameters; record a richer motion, or use a "
            "method with a prior."
        )


def solve_factor(R: Array) -> Array:
    """Return beta (r,) of R (r + 1, r + 1) known to have full rank."""
    r = R.shape[1] - 1
    return solve_triangular(R[:r, :r], R[:r, r])


def inverse_of(R: Array) -> Array:
    """R^-1 (r, r) of the regressor columns of R (r + 1, r + 1)."""
    r = R.shape[1] - 1
    return solve_triangular(R[:r, :r], np.eye(r))


def dense_rows(problem: Problem) -> tuple[Array, Array]:
    """W (N, m, r) and b (N, m) of a problem, all samples."""
    parts = list(problem.blocks())
    return np.concatenate([W for W, _ in parts]), np.concatenate([b for _, b in parts])


def covariance(R: Array) -> Array:
    """Covariance (r, r) of beta for rows of unit noise with the factor R (r + 1, r + 1)."""
    inverse = inverse_of(R)
    return np.asarray(inverse @ inverse.T)


def equations(problem: Problem) -> int:
    """Number of equations that some parameter acts on."""
    return sum(factor.samples for factor in problem.factors if len(factor.columns))


def data_rank(R: Array) -> int:
    """Number of directions that the data excite."""
    norms = np.linalg.norm(R, axis=0)
    if not norms.any():
        return 0
    # Unit columns: kg and kg m^2 differ by orders of magnitude without being dependent.
    values = np.linalg.svd(R / np.where(norms > 0, norms, 1.0), compute_uv=False)
    return int((values > EXCITED * values[0]).sum())


def direction_deviations(problem: Problem) -> tuple[Array, Array]:
    """Deviation (r,) that noise leaves to each direction Vt (r, r) of the base parameters with
    columns of unit length, relative to the whole answer; infinite without excitation.

    The torque b of N samples is U S V' x + e. White residuals of the least-squares fit leave v_i' x
    a deviation of |e| / (sqrt(N) s_i); the torque along the best excited direction is that of |x| =
    |b| / s_1. Residuals of real data are correlated, which makes this lenient.
    """
    r = problem.base.rank
    stacked = stacked_factor(problem)
    R, b = stacked[:r, :r], stacked[:, r]
    norms = np.linalg.norm(R, axis=0)
    if not norms.any():
        return np.full(r, np.inf), np.eye(r)
    _, s, Vt = np.linalg.svd(R / np.where(norms > 0, norms, 1.0))
    # |e| / (sqrt(N) |b|) of the fit: the last entry of Q'b is the norm of the residual.
    torque, count = np.linalg.norm(b), max(problem.samples * len(problem.rows), 1)
    noise = float(abs(b[-1]) / torque / np.sqrt(count)) if torque > 0 else 0.0
    excited = s > EXCITED * s[0]
    return np.where(excited, noise * s[0] / np.where(excited, s, 1.0), np.inf), Vt


def residual_norm(problem: Problem, beta: Array) -> Array:
    """|b_i - W_i beta| (rows,) of each row of the robot."""
    return np.array(
        [np.linalg.norm(f.R @ np.append(beta[f.columns], -1.0)) for f in problem.factors]
    )


ROUNDING: Final = 1e-10
"""Floor of a row's noise relative to its RMS torque: residuals below it are rounding error, which
must not weigh exact data by chance."""

RESIDUALS, RMS_TORQUE, MAX_TORQUE = "residuals", "rms-torque", "max-torque"
"""Ways to weigh rows: by the noise of each, or by the RMS or largest torque of its joint."""

WEIGHTS: Final = (RESIDUALS, RMS_TORQUE, MAX_TORQUE)


def scaled_fit(problem: Problem, sigma: Array | None = None) -> tuple[Array, Array, Array]:
    """Return (beta (r,), R (r + 1, r + 1), sigma (rows,)) of least squares with rows divided by
    `sigma`; None: `row_noise`. Raises EstimationError where the motion does not excite every
    direction.

    Excitation is checked on the unweighted rows: weights of very different size would hide it.
    """
    check_rank(stacked_factor(problem))
    sigma = row_noise(problem) if sigma is None else sigma
    R = stacked_factor(problem, (1.0 / sigma).tolist())
    return solve_factor(R), R, sigma


def row_noise(problem: Problem) -> Array:
    """Noise (rows,) of each row, from a fit of that row alone with N_j - b_j degrees of freedom,
    b_j the base parameters that row j depends on.

    A separate fit excludes the misfit of other rows: its expected variance is that of the row.
    """
    norms = _column_norms(problem)
    sigma = [_own_sigma(f, own) for f, own in zip(problem.factors, norms, strict=True)]
    return with_floor(problem, np.array(sigma))


def row_ranks(problem: Problem) -> Array:
    """Return the rank (rows,) of the columns of each row, which no choice of base parameters
    changes, as it does their number."""
    ranks = []
    for factor, norms in zip(problem.factors, _column_norms(problem), strict=True):
        values = np.linalg.svd(factor.R[:, :-1] / norms, compute_uv=False)
        ranks.append(int((values > EXCITED * values.max(initial=0.0)).sum()))
    return np.array(ranks)


def _column_norms(problem: Problem) -> list[Array]:
    """Norms of the columns of each row, infinite for those that are rounding."""
    sizes, norms = np.zeros(problem.base.rank), []
    for factor in problem.factors:
        # What is rounding in one row is judged by the size that its column has in any other.
        np.maximum.at(sizes, factor.columns, np.linalg.norm(factor.R[:, :-1], axis=0))
    for factor in problem.factors:
        # A column that is rounding error here, such as gravity about a vertical axis, is none:
        # divided by its norm it would explain noise, and another share of it with every rounding.
        own = np.linalg.norm(factor.R[:, :-1], axis=0)
        norms.append(np.where(own > ROUNDING * sizes[factor.columns], own, np.inf))
    return norms


def _own_sigma(factor: Factor, norms: Array) -> float:
    """Noise of one row; `norms` (k,) of its columns."""
    R, k = factor.R, len(factor.columns)
    if len(R) <= k:
        return 0.0
    # Below the triangle of [W | b], the last column of R holds the residual alone.
    rank, rest = k, R[k:, k]
    if np.abs(np.diag(R)[:k] / norms).min(initial=1.0) <= EXCITED:
        # With linearly dependent columns, rows of R within the triangle are residual as well.
        U, values, _ = np.linalg.svd(R[:, :k] / norms, full_matrices=False)
        rank = int((values > EXCITED * values[0]).sum())
        rest = R[:, k] - U[:, :rank] @ (U[:, :rank].T @ R[:, k])
    return float(np.linalg.norm(rest) / np.sqrt(max(factor.samples - rank, 1)))


def fit_noise(problem: Problem, beta: Array, R: Array, sigma: Array) -> Array:
    """Noise (rows,) of each row from the residual of the fit beta weighted by `sigma`, R (r + 1, r
    + 1) its factor: N_j - tr(H_jj) degrees of freedom, H the hat matrix.

    The leverages tr(H_jj) of all rows sum to r.
    """
    r = problem.base.rank
    rows = [spread(factor, r)[:, :r].T for factor in problem.factors]
    # tr(H_jj) = |W_j R^-1|^2 / sigma_j^2; R_j stands for W_j, whose Q does not matter.
    shares = [solve_triangular(R[:r, :r], part, trans="T") for part in rows]
    leverage = np.array([np.linalg.norm(share) ** 2 for share in shares]) / sigma**2
    samples = np.array([factor.samples for factor in problem.factors])
    freedom = np.maximum(samples - leverage, 1.0)
    return with_floor(problem, residual_norm(problem, beta) / np.sqrt(freedom))


def check_weights(weights: str) -> None:
    """Raise UsageError for a word that is not in WEIGHTS."""
    if weights not in WEIGHTS:
        raise unknown_name("way to weigh rows", weights, WEIGHTS)


def row_std(problem: Problem, weights: str) -> Array:
    """Deviations (rows,) that rows are divided by, N m or N.

    "residuals": `row_noise`. "rms-torque": the RMS torque of each joint times the RMS of the shares
    that the residuals have in it, so that errors count relative to the torque of their joint and a
    prior as much as before. "max-torque": the largest torque of each joint times one share. Raises
    UsageError for another word.
    """
    check_weights(weights)
    if weights == MAX_TORQUE:
        # Noise (rows,) of each row as one share of its largest |b|: the share is that of the
        # residuals of the fit with rows divided by max |b|, with M - r degrees of freedom for M
        # equations
        size = np.zeros(len(problem.rows))
        for _, b in problem.blocks():
            size = np.maximum(size, np.abs(b).max(axis=0, initial=0.0))
        size = with_floor(problem, size)
        beta, _, _ = scaled_fit(problem, size)
        equations = sum(factor.samples for factor in problem.factors)
        squares = float(((residual_norm(problem, beta) / size) ** 2).sum())
        share = np.sqrt(squares / max(equations - problem.base.rank, 1))
        return with_floor(problem, share * size)
    noise, torque = row_noise(problem), torque_rms(problem)
    loaded = torque > 0
    if weights == RESIDUALS or not loaded.any():
        return noise
    share = np.sqrt(((noise[loaded] / torque[loaded]) ** 2).mean())
    return with_floor(problem, share * torque)


def with_floor(problem: Problem, sigma: Array) -> Array:
    """Standard deviations (rows,) above rounding; a row without torque or columns has no weight, so
    that any positive number serves."""
    sigma = np.maximum(sigma, ROUNDING * torque_rms(problem))
    return np.where(sigma > 0, sigma, sigma.max() if sigma.any() else 1.0)


def torque_rms(problem: Problem) -> Array:
    """RMS (rows,) of each row's right-hand side."""
    return np.array(
        [np.linalg.norm(f.R[:, -1]) / np.sqrt(max(f.samples, 1)) for f in problem.factors]
    )
