"""M-estimates: least squares again and again, samples weighted by their residuals.

Each row of the robot has its own scale, the median of its absolute residuals over 0.6745: the
standard deviation of Gaussian noise, which outliers do not move (Holland and Welsch 1977).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.normal_qr import inverse_of, stacked_factor
from sysid_bench.identification.linear.residuals import at_rest, outlier_weights, residuals, step
from sysid_bench.identification.linear.weights import with_floor
from sysid_bench.types import Array, Estimate, Problem

MAD_OF_GAUSSIAN: Final = 0.6745
"""Median of |x| of the standard normal distribution."""

SETTLED: Final = 10
"""Iterations after which the scales are held: with held scales a convex loss always converges."""


@dataclass(frozen=True)
class Loss:
    """weight(u) = psi(u) / u of residuals u over their scale, and slope(u) = psi'(u)."""

    weight: Callable[[Array], Array]
    slope: Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Fit:
    """Where an M-estimate came to rest."""

    beta: Array  # (r,)
    scales: Array  # (rows,)
    iterations: int


def m_estimate(
    problem: Problem, loss: Loss, beta: Array, iterations: int, scales: Array | None = None
) -> Fit:
    """The M-estimate from a start beta (r,); given scales (rows,) are held.

    Raises EstimationError where `iterations` do not bring it to rest.
    """
    settled = 0 if scales is not None else SETTLED
    for iteration in range(1, iterations + 1):
        residual = residuals(problem, beta)
        if scales is None or iteration <= settled:
            scales = robust_scales(problem, residual)
        R = stacked_factor(problem, (1.0 / scales).tolist())[:-1, :-1]
        roots = np.sqrt(loss.weight(residual / scales)) / scales
        weighted = (
            (Y * root[..., None], rest * root)
            for Y, rest, root in outlier_weights(problem, residual, roots)
        )
        change, _ = step(R, weighted)
        beta = beta + change
        if iteration > settled and at_rest(R, change, beta):
            return Fit(beta, scales, iteration)
    raise EstimationError(
        f"The weights did not come to rest in {iterations} iterations; allow more, or ask whether "
        "most of the samples are outliers."
    )


def m_estimate_result(problem: Problem, loss: Loss, fit: Fit) -> Estimate:
    """The estimate of a fit, with the covariance A^-1 B A^-1 of Huber (1981, section 7.6):
    A = sum E psi' W_j'W_j / s_j^2, B = sum E psi^2 W_j'W_j / s_j^2, expectations over each row."""
    u = residuals(problem, fit.beta) / fit.scales
    weight = loss.weight(u)
    slope, squares = loss.slope(u).mean(axis=0), ((weight * u) ** 2).mean(axis=0)
    r = problem.base.rank
    outer = stacked_factor(problem, (np.sqrt(np.maximum(slope, 0.0)) / fit.scales).tolist())
    inner = stacked_factor(problem, (np.sqrt(squares) / fit.scales).tolist())[:r, :r]
    inverse = inverse_of(outer)
    spread = inverse @ inverse.T @ inner.T
    stats = {"iterations": float(fit.iterations), "least_weight": float(weight.min())}
    return Estimate(fit.beta, covariance=spread @ spread.T, stats=stats)


def robust_scales(problem: Problem, residual: Array) -> Array:
    """Scale (rows,) of each row's residuals (N, rows), above rounding."""
    return with_floor(problem, np.median(np.abs(residual), axis=0) / MAD_OF_GAUSSIAN)
