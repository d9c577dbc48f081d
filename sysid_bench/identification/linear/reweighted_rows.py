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
    covariance,
    scaled_fit,
    stacked_factor,
    with_floor,
)
from sysid_bench.types import Array, Estimate, Problem, RowBlock

KEPT: Final = 256e6
"""Most bytes of scaled samples that are kept; others are made again in every iteration."""

SMALL: Final = 1e-10
"""Share of the torques that the last step of a converged iteration may change."""

SETTLED: Final = "a step changes the torques by less than 1e-10 of them"


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


MAD_OF_GAUSSIAN: Final = 0.6745
"""Median of |x| of the standard normal distribution."""

HOLD_AFTER: Final = 10
"""Iterations after which the scales are held: with held scales a convex loss always converges."""


@dataclass(frozen=True)
class Loss:
    """Loss function by weight(u) = psi(u) / u and slope(u) = psi'(u) of scaled residuals u."""

    weight: Callable[[Array], Array]
    slope: Callable[[Array], Array]


def scaled_rows(problem: Problem) -> tuple[ScaledRows, Array]:
    """Return the samples scaled by the factor of `wls`, and its beta (r,)."""
    beta, weighted, _ = scaled_fit(problem)
    return ScaledRows(problem, weighted[:-1, :-1]), beta


@dataclass(frozen=True, eq=False)
class Reweighting:
    """Weights of one iteration: `blocks` makes the scaled samples times the roots of their weights,
    and `residual` (N, rows) is weighted."""

    blocks: Callable[[], Iterable[Array]]
    residual: Array


@dataclass(frozen=True, eq=False)
class ReweightedFit:
    """Fixed point of reweighted least squares, or the last iterate, with its weights."""

    beta: Array  # (r,)
    last: Reweighting
    iterations: int
    converged: bool

    def estimate(self, covariance: Array, stats: dict[str, float]) -> Estimate:
        """The estimate with a covariance (r, r) and the numbers of its method."""
        return Estimate(
            self.beta,
            covariance=covariance,
            stats=stats,
            converged=self.converged,
            iterations=self.iterations,
            stop=SETTLED if self.converged else f"the limit of {self.iterations} iterations",
        )


def reweighted_fit(
    rows: ScaledRows,
    beta: Array,
    iterations: int,
    weigh: Callable[[Array, int], Reweighting],
    hold_after: int = 0,
) -> ReweightedFit:
    """Return the fixed point from a start beta (r,): `weigh(residual, iteration)` makes the weights
    from residuals (N, rows). It can converge after iteration `hold_after`, from which `weigh` holds
    what could alternate for ever."""
    gamma, root, converged = rows.R @ beta, rows.R, False
    for iteration in range(1, iterations + 1):
        now = weigh(rows.residual(gamma), iteration)
        # The information is made anew in iterations 1, 2, 4, 8 and so on: a step with that of
        # similar weights has the same fixed point, for a hundredth of the products.
        if iteration & (iteration - 1) == 0:
            root = information_factor(now.blocks())
        # A step from the present residual, not a fit of b: an old or rounded factor changes the
        # way, and not the fixed point.
        change = np.asarray(cho_solve((root, False), rows.gradient(now.residual)))
        gamma = gamma + change
        # |gamma| = |R beta| is the size of the torques: the stop rule depends on no unit.
        small = np.linalg.norm(change) <= SMALL * np.linalg.norm(gamma)
        converged = iteration > hold_after and bool(small)
        if converged:
            break
    return ReweightedFit(solve_triangular(rows.R, gamma), now, iteration, converged)


def m_estimate(
    rows: ScaledRows, loss: Loss, beta: Array, iterations: int, scales: Array | None = None
) -> tuple[ReweightedFit, Array]:
    """Return the M-estimate from a start beta (r,), and the scales (rows,); given ones are held."""
    hold_after = 0 if scales is not None else HOLD_AFTER
    held = np.ones(len(rows.problem.rows)) if scales is None else scales

    def weigh(residual: Array, iteration: int) -> Reweighting:
        nonlocal held
        if iteration <= hold_after:
            held = row_scale(rows.problem, residual)
        weights = loss.weight(residual / held) / held**2
        roots = np.sqrt(weights)
        return Reweighting(
            lambda: (Q * root[..., None] for Q, root in rows.samples(roots)), weights * residual
        )

    return reweighted_fit(rows, beta, iterations, weigh, hold_after), held


def m_estimate_result(problem: Problem, loss: Loss, fit: ReweightedFit, scales: Array) -> Estimate:
    """Return the estimate with the covariance A^-1 B A^-1 of Huber (1981, section 7.6):
    A = sum E psi' W_j'W_j / s_j^2, B = sum E psi^2 W_j'W_j / s_j^2, expectations over each row."""
    u = np.concatenate([b - Y @ fit.beta for Y, b in problem.blocks()]) / scales
    weight = loss.weight(u)
    # weight * u is psi(u).
    slope, squares = loss.slope(u).mean(axis=0), ((weight * u) ** 2).mean(axis=0)
    r = problem.base.rank
    outer = stacked_factor(problem, (np.sqrt(np.maximum(slope, 0.0)) / scales).tolist())
    inner = stacked_factor(problem, (np.sqrt(squares) / scales).tolist())[:r, :r]
    spread = covariance(outer) @ inner.T
    return fit.estimate(spread @ spread.T, {"least_weight": float(weight.min())})


def row_scale(problem: Problem, residual: Array) -> Array:
    """MAD scale (rows,) of residuals (N, rows), above rounding, over the samples of each row."""
    # Samples that are left out have a residual of zero: they are the first of the sorted ones.
    columns = zip(np.sort(np.abs(residual), axis=0).T, problem.factors, strict=True)
    medians = np.array([np.median(size[-max(f.samples, 1) :]) for size, f in columns])
    return with_floor(problem, medians / MAD_OF_GAUSSIAN)
