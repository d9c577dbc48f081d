"""M-estimation by iteratively reweighted least squares.

Each row has its own scale, the median absolute residual over 0.6745 (MAD): the standard deviation
for Gaussian noise, insensitive to outliers (Holland and Welsch 1977).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.identification.linear.normal_qr import inverse_of, stacked_factor
from sysid_bench.identification.linear.residual import (
    SETTLED,
    ScaledRows,
    has_converged,
    information_factor,
    is_update,
    solve_step,
    torque_residual,
)
from sysid_bench.identification.linear.weights import scaled_fit, with_floor
from sysid_bench.types import Array, Estimate, Problem

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
