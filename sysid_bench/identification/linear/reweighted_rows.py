"""Iteratively reweighted least squares: residuals sample by sample, steps with a weight per sample.

In M-estimation each row has its own scale, the median absolute residual over 0.6745 (MAD): the
standard deviation for Gaussian noise, insensitive to outliers (Holland and Welsch 1977)."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve, solve_triangular

from sysid_bench.identification.linear.least_squares import (
    inverse_of,
    scaled_fit,
    stacked_factor,
    with_floor,
)
from sysid_bench.types import Array, Estimate, Problem, RowBlock

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


MAD_OF_GAUSSIAN: Final = 0.6745
"""Median of |x| of the standard normal distribution."""

HOLD_AFTER: Final = 10
"""Iterations after which the scales are held: with held scales a convex loss always converges."""


@dataclass(frozen=True)
class Loss:
    """Loss function by weight(u) = psi(u) / u and slope(u) = psi'(u) of scaled residuals u."""

    weight: Callable[[Array], Array]
    slope: Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Fit:
    """M-estimate, converged or not."""

    beta: Array  # (r,)
    scales: Array  # (rows,)
    iterations: int
    converged: bool


def scaled_rows(problem: Problem) -> tuple[ScaledRows, Array]:
    """Return the samples scaled by the factor of `wls`, and its beta (r,)."""
    beta, weighted, _ = scaled_fit(problem)
    return ScaledRows(problem, weighted[:-1, :-1]), beta


def m_estimate(
    rows: ScaledRows, loss: Loss, beta: Array, iterations: int, scales: Array | None = None
) -> Fit:
    """Return the M-estimate from a start beta (r,); given `scales` (rows,) are held."""
    hold_after = 0 if scales is not None else HOLD_AFTER
    gamma, root, converged = rows.R @ beta, rows.R, False
    for iteration in range(1, iterations + 1):
        residual = rows.residual(gamma)
        if scales is None or iteration <= hold_after:
            scales = row_scale(rows.problem, residual)
        weights = loss.weight(residual / scales) / scales**2
        if is_update(iteration):
            root = information_factor(_weighted(rows, np.sqrt(weights)))
        change = solve_step(root, rows.gradient(weights * residual))
        gamma = gamma + change
        converged = iteration > hold_after and has_converged(change, gamma)
        if converged:
            break
    assert scales is not None
    return Fit(solve_triangular(rows.R, gamma), scales, iteration, converged)


def _weighted(rows: ScaledRows, roots: Array) -> Iterator[Array]:
    """Blocks of scaled samples times `roots` (N, rows)."""
    return (Q * root[..., None] for Q, root in rows.samples(roots))


def m_estimate_result(problem: Problem, loss: Loss, fit: Fit) -> Estimate:
    """Return the estimate with the covariance A^-1 B A^-1 of Huber (1981, section 7.6):
    A = sum E psi' W_j'W_j / s_j^2, B = sum E psi^2 W_j'W_j / s_j^2, expectations over each row."""
    u = torque_residual(problem, fit.beta) / fit.scales
    weight = loss.weight(u)
    # weight * u is psi(u).
    slope, squares = loss.slope(u).mean(axis=0), ((weight * u) ** 2).mean(axis=0)
    r = problem.base.rank
    outer = stacked_factor(problem, (np.sqrt(np.maximum(slope, 0.0)) / fit.scales).tolist())
    inner = stacked_factor(problem, (np.sqrt(squares) / fit.scales).tolist())[:r, :r]
    inverse = inverse_of(outer)
    spread = inverse @ inverse.T @ inner.T
    return Estimate(
        fit.beta,
        covariance=spread @ spread.T,
        stats={"least_weight": float(weight.min())},
        converged=fit.converged,
        iterations=fit.iterations,
        stop=SETTLED if fit.converged else f"the limit of {fit.iterations} iterations",
    )


def row_scale(problem: Problem, residual: Array) -> Array:
    """MAD scale (rows,) of residuals (N, rows), above rounding, over the samples of each row."""
    # Samples that are left out have a residual of zero: they are the first of the sorted ones.
    columns = zip(np.sort(np.abs(residual), axis=0).T, problem.factors, strict=True)
    medians = np.array([np.median(size[-max(f.samples, 1) :]) for size, f in columns])
    return with_floor(problem, medians / MAD_OF_GAUSSIAN)
