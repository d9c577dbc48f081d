"""A problem by block of time: what a fit without one of them is judged or compared by.

Samples one period apart share a block, and so do those of equal phase in several motions: a part
that is left out must not be known from its repetition.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sysid_bench.qr_factor import qr_factor
from sysid_bench.time_labels import time_labels
from sysid_bench.types import Array, Factor, Problem, RowBlock


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
        joined = [_joined(row) for row in zip(*kept, strict=True)]
        return self._of(joined, self.labels != label)

    def _of(self, factors: Sequence[Factor], kept: Array) -> Problem:
        blocks = partial(_kept_blocks, self.problem, kept)
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
    factors = [
        [
            Factor(
                factor.row, factor.columns, _upper(found[label][i], factor), int(counts[label, i])
            )
            for i, factor in enumerate(problem.factors)
        ]
        for label in range(count)
    ]
    return TimeBlocks(problem, labels, factors)


def _upper(parts: list[Array], factor: Factor) -> Array:
    """R of the stacked parts; without any row where there is none."""
    return qr_factor(parts) if parts else np.zeros((0, factor.R.shape[1]))


def _labelled(problem: Problem, labels: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield labels (n,), W and b of the blocks of a problem."""
    done = 0
    for W, b in problem.blocks():
        yield labels[done : done + len(b)], W, b
        done += len(b)


def _kept_blocks(problem: Problem, kept: Array) -> Iterator[RowBlock]:
    """Yield the rows of a problem, zero at the samples that are not `kept` (N,)."""
    for part, W, b in _labelled(problem, kept):
        yield W * part[:, None, None], b * part[:, None]


def _joined(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several parts."""
    R = qr_factor([factor.R for factor in factors])
    return replace(factors[0], R=R, samples=sum(factor.samples for factor in factors))
