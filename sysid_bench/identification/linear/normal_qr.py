"""Least squares from the R factors of a problem (normal equations in square-root form)."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.linalg import lapack, solve_triangular

from sysid_bench.errors import EstimationError
from sysid_bench.types import Array, Factor, Problem

EXCITED: Final = 1e-9
"""Excitation threshold: directions with a smaller singular value (unit columns, relative to the
largest) contain rounding error alone."""


def stacked_factor(problem: Problem, weights: Sequence[float] | None = None) -> Array:
    """R (r + 1, r + 1) of [W | b], each row of the robot times its weight."""
    r = problem.base.rank
    scales = [1.0] * len(problem.factors) if weights is None else weights
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


def data_rank(R: Array) -> int:
    """Number of directions that the data excite."""
    norms = np.linalg.norm(R, axis=0)
    if not norms.any():
        return 0
    # Unit columns: kg and kg m^2 differ by orders of magnitude without being dependent.
    values = np.linalg.svd(R / np.where(norms > 0, norms, 1.0), compute_uv=False)
    return int((values > EXCITED * values[0]).sum())


def residual_norm(problem: Problem, beta: Array) -> Array:
    """|b_i - W_i beta| (rows,) of each row of the robot."""
    return np.array(
        [np.linalg.norm(f.R @ np.append(beta[f.columns], -1.0)) for f in problem.factors]
    )
