"""Spread of an estimate over blocks of time, for methods that give no covariance of their own.

Feasible and regularised fits are not linear in the data: no formula of least squares is theirs. The
delete-a-group jackknife (Tukey 1958; Busing, Meijer, van der Leeden 1999) repeats the fit with each
block of time left out, constraints and prior included. A parameter that a constraint holds in every
fit does not move: its spread of zero is no deviation, and it has none.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from sysid_bench.evaluation.score import base_parameters
from sysid_bench.evaluation.standard_error import StandardError
from sysid_bench.identification.identify import identify
from sysid_bench.qr_factor import upper_factor
from sysid_bench.types import Array, Estimate, Factor, Problem, RowBlock

BLOCKS: Final = 8
"""Parts of the motion: a deviation from them is itself uncertain by a quarter."""

HELD: Final = 1e-7
"""Spread relative to the value below which a constraint holds a parameter in all fits: the
tolerance of the solvers."""


@dataclass(frozen=True, eq=False)
class _Parts:
    """Rows of a problem by block of time: `labels` (N,) of its samples, and the factors (BLOCKS,
    rows)."""

    problem: Problem
    labels: Array
    factors: Sequence[Sequence[Factor]]

    def without(self, label: int) -> Problem:
        """Return the problem without one block."""
        kept = [part for k, part in enumerate(self.factors) if k != label]
        return replace(
            self.problem,
            factors=tuple(_joined(row) for row in zip(*kept, strict=True)),
            blocks=partial(_blocks_without, self, label),
            motions=(),
        )


def block_errors(problem: Problem, estimate: Estimate, method: Any) -> StandardError | str:
    """Return the jackknife covariance of an estimate over blocks of time; or the reason why there
    is none.

    Its deviation is NaN for base parameters that a constraint holds. Samples one period apart share
    a block, or the left-out part would be known from its repetition.
    """
    if not hasattr(method, "solve"):
        return (
            "no ±: the method states no covariance, and leaving parts of the motion out would take "
            f"{BLOCKS} times its simulations"
        )
    if estimate.beta is None or problem.samples * len(problem.rows) < 4 * problem.base.rank:
        return "no ±: too few samples to leave parts of the motion out"
    parts, betas = _parts(problem), []
    for label in range(BLOCKS):
        again = identify(method, parts.without(label))
        beta = base_parameters(again)
        if beta is None:
            return f"no ±: with a part of the motion left out there is no estimate: {again.reason}"
        betas.append(beta)
    moved = np.sqrt((BLOCKS - 1) / BLOCKS) * (np.array(betas) - np.mean(betas, axis=0))
    still = np.sqrt((moved**2).sum(axis=0)) <= HELD * np.abs(estimate.beta)
    moved[:, still] = np.nan
    return StandardError(moved.T @ moved, BLOCKS - 1)


def _parts(problem: Problem) -> _Parts:
    """Split the rows of a problem."""
    period = problem.period or problem.samples
    labels = (np.arange(problem.samples) % period) * BLOCKS // period
    rows = range(len(problem.rows))
    found: list[list[list[Array]]] = [[[] for _ in rows] for _ in range(BLOCKS)]
    counts = np.zeros((BLOCKS, len(problem.rows)), dtype=int)
    for part, W, b in _labelled(problem, labels):
        for i, factor in enumerate(problem.factors):
            Wb = np.column_stack([W[:, i, factor.columns], b[:, i]])
            for label in np.unique(part).tolist():
                chosen = Wb[part == label]
                found[label][i].append(upper_factor([chosen]))
                counts[label, i] += int(chosen.any(axis=1).sum())
    factors = [
        [
            Factor(factor.row, factor.columns, upper_factor(found[label][i]), int(counts[label, i]))
            for i, factor in enumerate(problem.factors)
        ]
        for label in range(BLOCKS)
    ]
    return _Parts(problem, labels, factors)


def _labelled(problem: Problem, labels: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield labels (n,), W and b of the blocks of a problem."""
    done = 0
    for W, b in problem.blocks():
        yield labels[done : done + len(b)], W, b
        done += len(b)


def _blocks_without(parts: _Parts, label: int) -> Iterator[RowBlock]:
    """Yield the rows of a problem, those of one block of time zero."""
    for part, W, b in _labelled(parts.problem, parts.labels):
        kept = part != label
        yield W * kept[:, None, None], b * kept[:, None]


def _joined(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several parts."""
    R = upper_factor([factor.R for factor in factors])
    return replace(factors[0], R=R, samples=sum(factor.samples for factor in factors))
