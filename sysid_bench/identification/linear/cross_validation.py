"""Cross-validation over blocks of time, and one rule for the weight of every regularised method.

Samples one period apart share a block, and so do those of equal phase in several motions: a part
that is left out must not be known from its repetition."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.feasibility.feasible_set import NOISE
from sysid_bench.identification.linear.least_squares import residual_norm, row_noise, torque_rms
from sysid_bench.numerics import qr_factor, time_labels
from sysid_bench.types import Array, Estimate, Factor, Problem, RowBlock


@dataclass(frozen=True, eq=False)
class TimeBlocks:
    """Rows of a problem by block of time: `labels` (N,) of its samples, and the `factors` (blocks,
    rows)."""

    problem: Problem
    labels: Array
    factors: Sequence[Sequence[Factor]]

    def part(self, label: int) -> Problem:
        """Return the problem of one block alone."""
        return self._of(self.factors[label], self.labels == label)

    def without(self, label: int) -> Problem:
        """Return the problem without one block."""
        kept = [part for k, part in enumerate(self.factors) if k != label]
        joined = []
        for parts in zip(*kept, strict=True):  # the same row in several blocks
            R = qr_factor([factor.R for factor in parts])
            samples = sum(factor.samples for factor in parts)
            joined.append(replace(parts[0], R=R, samples=samples))
        return self._of(joined, self.labels != label)

    def _of(self, factors: Sequence[Factor], kept: Array) -> Problem:
        def blocks() -> Iterator[RowBlock]:
            """The rows, zero at the samples that are not `kept` (N,)."""
            for part, W, b in _labelled(self.problem, kept):
                yield W * part[:, None, None], b * part[:, None]

        return replace(self.problem, factors=tuple(factors), blocks=blocks, motions=())


def block_labels(problem: Problem, count: int) -> Array:
    """Return the block (N,), 0 to count - 1, of each sample: by its phase in the period or
    in what repeats, or in the motion where nothing does."""
    motions = problem.motions or (problem,)
    return np.concatenate(
        [time_labels(one.samples, one.period or one.repetition, count) for one in motions]
    )


def time_blocks(problem: Problem, count: int) -> TimeBlocks:
    """Split the rows of a problem into `count` blocks of time."""
    labels = block_labels(problem, count)
    rows = range(len(problem.rows))
    found: list[list[list[Array]]] = [[[] for _ in rows] for _ in range(count)]
    counts = np.zeros((count, len(problem.rows)), dtype=int)
    for part, W, b in _labelled(problem, labels):
        for i, factor in enumerate(problem.factors):
            Wb = np.column_stack([W[:, i, factor.columns], b[:, i]])
            for label in np.unique(part).tolist():
                chosen = Wb[part == label]
                found[label][i].append(qr_factor([chosen]))
                counts[label, i] += int(chosen.any(axis=1).sum())
    factors = []
    for parts, samples in zip(found, counts.tolist(), strict=True):
        # A block without any sample has a factor without any row.
        roots = [
            qr_factor(part) if part else np.zeros((0, factor.R.shape[1]))
            for part, factor in zip(parts, problem.factors, strict=True)
        ]
        factors.append(
            [
                Factor(factor.row, factor.columns, R, count)
                for factor, R, count in zip(problem.factors, roots, samples, strict=True)
            ]
        )
    return TimeBlocks(problem, labels, factors)


def _labelled(problem: Problem, labels: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield labels (n,), W and b of the blocks of a problem."""
    done = 0
    for W, b in problem.blocks():
        yield labels[done : done + len(b)], W, b
        done += len(b)


CROSS_VALIDATED: Final = "cross-validated"
"""Word that takes the place of a weight."""

FOLDS: Final = 5
"""Blocks of time, each held out once."""

WEIGHTS: Final = tuple(10.0**k for k in range(-2, 7))
"""Weights that are tried: from a hundredth of one sample to a million samples."""

Fit = Callable[[Problem, float], Estimate]
"""Fit of a problem with a weight."""


def check_weight(weight: float | str) -> None:
    """Raise UsageError unless a weight is a positive finite number or the word CROSS_VALIDATED."""
    is_number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
    if weight != CROSS_VALIDATED and not (is_number and 0 < float(weight) < np.inf):
        raise UsageError(
            f"The weight {weight!r} is neither a positive finite number nor {CROSS_VALIDATED!r}; "
            "give one of them."
        )


def with_weight(
    fit: Fit, problem: Problem, weight: float | str, grid: tuple[float, ...] = WEIGHTS
) -> Estimate:
    """Return the fit with a weight, which is then one of its numbers; CROSS_VALIDATED chooses it.

    The motion is cut into FOLDS blocks of time; samples of equal phase in several periods share a
    block, since a repeated period would be known from the others. Each weight of the `grid` is
    fitted to all blocks but one and predicts that one; the sum over blocks of the squared errors,
    each row divided by its noise, is the least with the chosen weight, with which all samples are
    fitted. Every grid has as many weights as WEIGHTS, so that all methods have the same budget. A
    fit that fails, or whose error is not finite, loses its weight. The numbers `weight`,
    `least_weight`, `most_weight` (ends of the grid) and `fits` show what was done. Stone (1974).

    Training samples reach to the edges of the block that is held out, without a gap: there,
    filtered noise is shared by both sides over about the inverse of the filter's bandwidth. Blocks
    that are not much longer than that favour small weights. Raises EstimationError where no weight
    is left, with the reason of the fits where all of them have the same.
    """
    if weight != CROSS_VALIDATED:
        chosen, numbers = float(weight), {}
    else:
        chosen = grid[int(np.argmin(held_out_errors(fit, problem, grid)))]
        count = float(FOLDS * len(grid) + 1)
        numbers = {"least_weight": grid[0], "most_weight": grid[-1], "fits": count}
    estimate = fit(problem, chosen)
    return replace(estimate, stats={**estimate.stats, "weight": chosen, **numbers})


def held_out_errors(
    fit: Fit, problem: Problem, grid: tuple[float, ...], sigma: Array | None = None
) -> list[float]:
    """Return the error of each weight on the blocks that it was not fitted to: mean square of
    residuals over `sigma` of their row (rows,; None: its noise); infinite where a fit fails or its
    error is not finite. Raises EstimationError where all are infinite."""
    blocks = time_blocks(problem, FOLDS)
    if sigma is None:
        # One measure of all weights: the noise of the whole motion, as feasible fits bound it.
        sigma = np.maximum(row_noise(problem), NOISE * torque_rms(problem))
    sigma = np.where(sigma > 0, sigma, 1.0)
    folds = [(blocks.without(label), blocks.part(label)) for label in range(FOLDS)]
    total = max(sum(factor.samples for factor in problem.factors), 1)
    found = [[_error(fit, fold, weight, sigma) for fold in folds] for weight in grid]
    errors = [sum(error for error, _ in of_weight) / total for of_weight in found]
    if np.isinf(errors).all():
        reasons = [reason for of_weight in found for _, reason in of_weight]
        if len({*reasons}) == 1:
            raise EstimationError(reasons[0])
        raise EstimationError(
            f"No weight from {grid[0]:g} to {grid[-1]:g} gives a fit of every part of the motion "
            f"(the first that failed: {next(filter(None, reasons))}); record a longer motion, or "
            "give a weight."
        )
    return errors


def _error(
    fit: Fit, fold: tuple[Problem, Problem], weight: float, sigma: Array
) -> tuple[float, str]:
    """Sum of the squares of the errors of one fold; infinite with a reason where there is none."""
    train, test = fold
    try:
        estimate = fit(train, weight)
    except (EstimationError, np.linalg.LinAlgError) as error:
        # A weight whose fit fails in one part loses, and does not end the search.
        return np.inf, str(error)
    beta = estimate.beta if estimate.theta is None else train.base.K @ estimate.theta
    assert beta is not None
    error_squared = float(((residual_norm(test, beta) / sigma) ** 2).sum())
    if not np.isfinite(error_squared):
        return np.inf, f"its error is {error_squared}"
    return error_squared, ""


@dataclass(frozen=True)
class WeightedPrior(ABC):
    """Base of fits that a prior draws with a `weight`, a number or CROSS_VALIDATED."""

    weight: float | str = 1.0

    def __post_init__(self) -> None:
        """Raise UsageError for a weight that is neither positive nor the word for tuning."""
        check_weight(self.weight)

    def solve(self, problem: Problem) -> Estimate:
        """Return theta, also where the motion does not excite every direction; raises
        EstimationError without a prior, or where the fit finds no solution."""
        return with_weight(self._fit, problem, self.weight)

    @abstractmethod
    def _fit(self, problem: Problem, weight: float) -> Estimate:
        """The fit with a weight that is a number."""
