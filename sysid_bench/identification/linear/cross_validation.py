"""One rule for the weight of every regularised method: cross-validation over blocks of time."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.linear.base_coordinates import NOISE
from sysid_bench.identification.linear.normal_qr import residual_norm
from sysid_bench.identification.linear.time_blocks import time_blocks
from sysid_bench.identification.linear.weights import row_noise, torque_rms
from sysid_bench.types import Array, Estimate, Problem

CROSS_VALIDATED: Final = "cross-validated"
"""Word that takes the place of a weight."""

FOLDS: Final = 5
"""Blocks of time, each held out once."""

WEIGHTS: Final = tuple(10.0**k for k in range(-2, 7))
"""Weights that are tried: from a hundredth of one sample to a million samples."""

Fit = Callable[[Problem, float], Estimate]
"""Fit of a problem with a weight."""


def check_weight(weight: float | str) -> None:
    """Raise UsageError unless a weight is a positive number or the word CROSS_VALIDATED."""
    is_number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
    if weight != CROSS_VALIDATED and not (is_number and float(weight) > 0):
        raise UsageError(
            f"The weight {weight!r} is neither a positive number nor {CROSS_VALIDATED!r}; give one "
            "of them."
        )


def regularised(
    fit: Fit, problem: Problem, weight: float | str, grid: tuple[float, ...] = WEIGHTS
) -> Estimate:
    """Return the fit with a weight, which is then one of its numbers; CROSS_VALIDATED chooses it.

    The motion is cut into FOLDS blocks of time; samples of equal phase in several periods share a
    block, since a repeated period would be known from the others. Each weight of the `grid` is
    fitted to all blocks but one and predicts that one; the sum over blocks of the squared errors,
    each row divided by its noise, is the least with the chosen weight, with which all samples are
    fitted. Every grid has as many weights as WEIGHTS, so that all methods have the same budget. A
    fit that fails loses its weight. The numbers `weight`, `least_weight`, `most_weight` (ends of
    the grid) and `fits` show what was done. Stone (1974); blocks of time: Burman, Chow, Nolan
    (1994). Raises EstimationError where no weight is left.
    """
    if weight != CROSS_VALIDATED:
        return _with_numbers(fit(problem, float(weight)), {"weight": float(weight)})
    errors = np.array(held_out_errors(fit, problem, grid))
    if not np.isfinite(errors).any():
        raise EstimationError(
            f"No weight from {grid[0]:g} to {grid[-1]:g} gives a fit of every part of the motion; "
            "record a longer motion, or give a weight."
        )
    chosen = grid[int(np.argmin(errors))]
    numbers = {
        "weight": chosen,
        "least_weight": grid[0],
        "most_weight": grid[-1],
        "fits": float(FOLDS * len(grid) + 1),
    }
    return _with_numbers(fit(problem, chosen), numbers)


def held_out_errors(fit: Fit, problem: Problem, grid: tuple[float, ...]) -> list[float]:
    """Return the error of each weight on the blocks that it was not fitted to: mean square of
    residuals over the noise of their row; infinite where a fit fails."""
    blocks = time_blocks(problem, FOLDS)
    # One measure of all weights: the noise of the whole motion, as feasible fits bound it.
    sigma = np.maximum(row_noise(problem), NOISE * torque_rms(problem))
    sigma = np.where(sigma > 0, sigma, 1.0)
    folds = [(blocks.without(label), blocks.part(label)) for label in range(FOLDS)]
    total = max(sum(factor.samples for factor in problem.factors), 1)
    return [sum(_error(fit, fold, weight, sigma) for fold in folds) / total for weight in grid]


def _error(fit: Fit, fold: tuple[Problem, Problem], weight: float, sigma: Array) -> float:
    """Sum of the squares of the errors of one fold."""
    train, test = fold
    try:
        estimate = fit(train, weight)
    except (EstimationError, np.linalg.LinAlgError):
        return np.inf
    beta = estimate.beta if estimate.theta is None else train.base.K @ estimate.theta
    assert beta is not None
    return float(((residual_norm(test, beta) / sigma) ** 2).sum())


def _with_numbers(estimate: Estimate, numbers: dict[str, float]) -> Estimate:
    return replace(estimate, stats={**estimate.stats, **numbers})
