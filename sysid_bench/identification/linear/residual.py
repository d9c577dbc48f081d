"""Residuals sample by sample, and least-squares steps with a weight per sample."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sysid_bench.types import Array, Problem


def torque_residual(problem: Problem, beta: Array) -> Array:
    """b - W beta of each sample (N, rows)."""
    return np.concatenate([b - Y @ beta for Y, b in problem.blocks()])


def blocks_of_samples(problem: Problem, *values: Array) -> Iterator[tuple[Array, ...]]:
    """Blocks of the regressor (n, rows, r), each with its samples of the `values` (N, ...)."""
    start = 0
    for Y, b in problem.blocks():
        end = start + len(b)
        yield Y, *(each[start:end] for each in values)
        start = end


def step(R: Array, blocks: Iterable[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Least-squares step (r,) of weighted rows (Y, residual), and C (r, r) with C C' its covariance
    for unit noise.

    R (r, r) is a factor of similar rows: Y R^-1 is nearly orthonormal, so that its normal equations
    lose no digits, and the next step corrects the rounding error of this one.
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


def has_converged(R: Array, change: Array, beta: Array, share: float = 1e-10) -> bool:
    """Return whether a step changes the torques, by the factor R (r, r), by less than `share` of
    them."""
    return bool(np.linalg.norm(R @ change) <= share * np.linalg.norm(R @ beta))
