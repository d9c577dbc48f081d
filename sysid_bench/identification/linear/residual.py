"""Residuals sample by sample, and least-squares steps with a weight per sample."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve, solve_triangular

from sysid_bench.types import Array, Problem, RowBlock

KEPT: Final = 256e6
"""Most bytes of scaled samples that are kept; others are made again in every iteration."""

SETTLED: Final = "a step changes the torques by less than 1e-10 of them"


def torque_residual(problem: Problem, beta: Array) -> Array:
    """b - W beta of each sample (N, rows)."""
    return np.concatenate([b - Y @ beta for Y, b in problem.blocks()])


@dataclass(frozen=True, eq=False)
class ScaledRows:
    """Samples Q = Y R^-1 of a problem in the unknowns gamma = R beta, R (r, r) a factor of similar
    rows: Q is nearly orthonormal, so that its normal equations lose no digits, and the next step
    corrects the rounding error of this one."""

    problem: Problem
    R: Array

    def blocks(self) -> Iterable[RowBlock]:
        """Blocks of Q (n, rows, r) and b (n, rows), in time order."""
        return self._scaled() if self._kept is None else self._kept

    @cached_property
    def _kept(self) -> list[RowBlock] | None:
        size = 8 * self.problem.samples * len(self.problem.rows) * len(self.R)
        return list(self._scaled()) if size <= KEPT else None

    def _scaled(self) -> Iterator[RowBlock]:
        r = len(self.R)
        for Y, b in self.problem.blocks():
            Q = solve_triangular(self.R, Y.reshape(-1, r).T, trans="T").T
            yield Q.reshape(Y.shape), b

    def samples(self, *values: Array) -> Iterator[tuple[Array, ...]]:
        """Blocks of Q (n, rows, r), each with its samples of the `values` (N, ...)."""
        start = 0
        for Q, b in self.blocks():
            end = start + len(b)
            yield Q, *(each[start:end] for each in values)
            start = end

    def residual(self, gamma: Array) -> Array:
        """b - Q gamma of each sample (N, rows)."""
        return np.concatenate([b - Q @ gamma for Q, b in self.blocks()])

    def gradient(self, values: Array) -> Array:
        """Q' values (r,) of values (N, rows)."""
        parts = [each.ravel() @ Q.reshape(-1, len(self.R)) for Q, each in self.samples(values)]
        return np.asarray(np.sum(parts, axis=0))

    def covariance(self, factor: Array) -> Array:
        """Covariance (r, r) of beta for unit noise and a Cholesky factor of the information."""
        half = solve_triangular(factor @ self.R, np.eye(len(factor)))
        return np.asarray(half @ half.T)


def information_factor(blocks: Iterable[Array]) -> Array:
    """Upper Cholesky factor (r, r) of the sum of Q'Q over blocks (n, rows, r)."""
    total: Array | None = None
    for Q in blocks:
        rows = Q.reshape(-1, Q.shape[-1])
        # Fortran order of the transpose: no copy, and half of the products.
        part = blas.dsyrk(1.0, rows.T)
        total = part if total is None else total + part
    assert total is not None
    return np.triu(cho_factor(total)[0])


def solve_step(factor: Array, gradient: Array) -> Array:
    """Step (r,) of the normal equations with an upper Cholesky factor."""
    return np.asarray(cho_solve((factor, False), gradient))


def is_update(iteration: int) -> bool:
    """Return whether the information is computed anew: in iterations 1, 2, 4, 8 and so on.

    A step with the information of similar weights has the same fixed point, for a hundredth of the
    products.
    """
    return iteration & (iteration - 1) == 0


def has_converged(change: Array, gamma: Array, share: float = 1e-10) -> bool:
    """Return whether a step (r,) changes the scaled torques by less than `share` of them."""
    return bool(np.linalg.norm(change) <= share * np.linalg.norm(gamma))
