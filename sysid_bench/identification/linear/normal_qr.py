"""What every least-squares method needs from a problem's R factors."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.linalg import lapack, solve_triangular

from sysid_bench.errors import EstimationError
from sysid_bench.types import Array, Factor, Problem

EXCITED: Final = 1e-9
"""A direction whose singular value, with unit columns, is below this share of the largest is not
excited by the data: what is found along it is rounding error."""


def stacked_factor(problem: Problem, weights: Sequence[float] | None = None) -> Array:
    """R (r + 1, r + 1) of [W | b] with each row of the robot times its weight."""
    r = problem.base.rank
    scales = [1.0] * len(problem.factors) if weights is None else weights
    parts = [
        scale * spread(factor, r) for factor, scale in zip(problem.factors, scales, strict=True)
    ]
    stack = np.asfortranarray(np.concatenate([*parts, np.zeros((r + 1, r + 1))]))
    packed, _, _, _ = lapack.dgeqrf(stack, lwork=64 * (r + 1), overwrite_a=1)
    return np.triu(packed[: r + 1])


def spread(factor: Factor, r: int) -> Array:
    """A factor's rows (m, r + 1) with its columns at their places among all base parameters."""
    wide = np.zeros((len(factor.R), r + 1))
    wide[:, factor.columns] = factor.R[:, :-1]
    wide[:, r] = factor.R[:, -1]
    return wide


def solve(R: Array) -> Array:
    """beta (r,) that minimises |R [beta; -1]|; raises EstimationError naming the rank it has."""
    require_excited(R)
    return solve_upper(R)


def require_excited(R: Array) -> None:
    """Raises EstimationError where the data do not excite every base parameter."""
    r = R.shape[1] - 1
    rank = excited_rank(R[:r, :r])
    if rank < r:
        raise EstimationError(
            f"The motion excites {rank} of {r} base parameters; record a richer motion, or use a "
            "method with a prior."
        )


def solve_upper(R: Array) -> Array:
    """beta (r,) of R (r + 1, r + 1) whose data are known to excite every direction."""
    r = R.shape[1] - 1
    return solve_triangular(R[:r, :r], R[:r, r])


def inverse_of(R: Array) -> Array:
    """R^-1 (r, r) of the base parameters' part of R (r + 1, r + 1)."""
    r = R.shape[1] - 1
    return solve_triangular(R[:r, :r], np.eye(r))


def excited_rank(R: Array) -> int:
    """How many directions the data excite."""
    norms = np.linalg.norm(R, axis=0)
    if not norms.any():
        return 0
    values = np.linalg.svd(R / np.where(norms > 0, norms, 1.0), compute_uv=False)
    return int((values > EXCITED * values[0]).sum())


def residual_norms(problem: Problem, beta: Array) -> Array:
    """|b_i - W_i beta| of every row of the robot (rows,)."""
    return np.array(
        [np.linalg.norm(f.R @ np.append(beta[f.columns], -1.0)) for f in problem.factors]
    )
