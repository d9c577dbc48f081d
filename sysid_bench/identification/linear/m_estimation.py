"""M-estimation by iteratively reweighted least squares.

Each row has its own scale, the median absolute residual over 0.6745 (MAD): the standard deviation
for Gaussian noise, insensitive to outliers (Holland and Welsch 1977).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.normal_qr import inverse_of, stacked_factor
from sysid_bench.identification.linear.residual import (
    blocks_of_samples,
    has_converged,
    step,
    torque_residual,
)
from sysid_bench.identification.linear.weights import with_floor
from sysid_bench.types import Array, Estimate, Problem, RowBlock

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
    """Converged M-estimate."""

    beta: Array  # (r,)
    scales: Array  # (rows,)
    iterations: int


def m_estimate(
    problem: Problem, loss: Loss, beta: Array, iterations: int, scales: Array | None = None
) -> Fit:
    """Return the M-estimate from a start beta (r,); given `scales` (rows,) are held.

    Raises EstimationError where it does not converge in `iterations`."""
    hold_after = 0 if scales is not None else HOLD_AFTER
    for iteration in range(1, iterations + 1):
        residual = torque_residual(problem, beta)
        if scales is None or iteration <= hold_after:
            scales = row_scale(problem, residual)
        R = stacked_factor(problem, (1.0 / scales).tolist())[:-1, :-1]
        roots = np.sqrt(loss.weight(residual / scales)) / scales
        change, _ = step(R, _scaled_blocks(problem, residual, roots))
        beta = beta + change
        if iteration > hold_after and has_converged(R, change, beta):
            return Fit(beta, scales, iteration)
    raise EstimationError(
        f"The method did not converge in {iterations} iterations; allow more, or check whether "
        "most samples are outliers."
    )


def _scaled_blocks(problem: Problem, residual: Array, roots: Array) -> Iterator[RowBlock]:
    """Blocks of the regressor and the residuals, samples and rows times `roots` (N, rows)."""
    for Y, rest, root in blocks_of_samples(problem, residual, roots):
        yield Y * root[..., None], rest * root


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
    stats = {"iterations": float(fit.iterations), "least_weight": float(weight.min())}
    return Estimate(fit.beta, covariance=spread @ spread.T, stats=stats)


def row_scale(problem: Problem, residual: Array) -> Array:
    """MAD scale (rows,) of residuals (N, rows), above rounding, over the samples of each row."""
    # Samples that are left out have a residual of zero: they are the first of the sorted ones.
    columns = zip(np.sort(np.abs(residual), axis=0).T, problem.factors, strict=True)
    medians = np.array([np.median(size[-max(f.samples, 1) :]) for size, f in columns])
    return with_floor(problem, medians / MAD_OF_GAUSSIAN)
