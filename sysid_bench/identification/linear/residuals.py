"""What methods that look at every sample need: residuals, and steps that weigh each sample."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sysid_bench.types import Array, Problem


def residuals(problem: Problem, beta: Array) -> Array:
    """b - W beta of every sample (N, rows)."""
    return np.concatenate([b - Y @ beta for Y, b in problem.blocks()])


def outlier_weights(problem: Problem, *values: Array) -> Iterator[tuple[Array, ...]]:
    """Blocks of the regressor (n, rows, r), each with its samples of the `values` (N, ...)."""
    start = 0
    for Y, b in problem.blocks():
        end = start + len(b)
        yield Y, *(each[start:end] for each in values)
        start = end


def step(R: Array, blocks: Iterable[tuple[Array, Array]]) -> tuple[Array, Array]:
    """The least-squares step (r,) of weighted rows (Y, residual), and C (r, r) with C C' the
    covariance of the estimate where these rows have unit noise.

    `R` (r, r) is a factor of similar rows: Y R^-1 is nearly orthonormal, so that squaring it loses
    nothing, and what the step lacks the next one, from its own residual, makes up for.
    """
    r = len(R)
    information, gradient = np.zeros((r, r)), np.zeros(r)
    for Y, residual in blocks:
        Q = solve_triangular(R, Y.reshape(-1, r).T, trans="T")
        information += Q @ Q.T
        gradient += Q @ residual.ravel()
    factor = cho_factor(information)
    upper = np.triu(factor[0])
    spread = solve_triangular(upper @ R, np.eye(r))
    return solve_triangular(R, cho_solve(factor, gradient)), spread


def at_rest(R: Array, change: Array, beta: Array, share: float = 1e-10) -> bool:
    """Whether a step changes the torques of the factor R (r, r) by less than `share` of them."""
    return bool(np.linalg.norm(R @ change) <= share * np.linalg.norm(R @ beta))
