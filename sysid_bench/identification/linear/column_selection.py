"""Which columns are worth having: chosen by what they predict on parts that were left out.

Everything happens inside the training data. Factors of every fold are computed once, with all
candidates; a set of columns is a choice of columns in them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.types import Array

GAIN: Final = 0.02
"""Relative; a column has to lower its joint's error on left-out parts by as much."""

RIDGE: Final = 1e-9
"""Of unit columns: keeps directions that a fold does not excite from growing."""


@dataclass(frozen=True, eq=False)
class FoldedRow:
    """One joint in one fold: R (k + 1, k + 1) of [W | b] of what is trained on and of what is left
    out, all candidate columns at their places among all, and how many samples are left out."""

    train: Array
    test: Array


@dataclass(frozen=True, eq=False)
class ColumnSelection:
    """The columns chosen (places), and what was added at each step with the mean error after it."""

    columns: tuple[int, ...]
    steps: tuple[tuple[int, float], ...]
    error_before: float
    error_after: float


def select_columns(
    folds: Sequence[Sequence[FoldedRow]],
    start: Sequence[int],
    candidates: Sequence[tuple[Sequence[int], int]],
) -> ColumnSelection:
    """Forward selection: of the candidates (rows, column) the one that lowers the error of one of
    its rows most is added, until none lowers any by GAIN. `folds[f][i]` is row i in fold f.

    Rows are weighted by their RMS torque in training, so that each counts alike.
    """
    weights = _weights(folds)
    grams = [_gram(fold, weights) for fold in folds]
    current = list(start)
    errors = _errors(folds, grams, current)
    before = float(np.sqrt(np.mean(errors**2)))
    steps: list[tuple[int, float]] = []
    left = list(candidates)
    while left:
        trials = []
        for rows, column in left:
            trial = [*current, column]
            told = _errors(folds, grams, trial)
            total = float(np.sqrt(np.mean(told**2)))
            gain = float(np.max(1.0 - told[list(rows)] / errors[list(rows)]))
            trials.append((gain, total, column, trial, told))
        base = float(np.sqrt(np.mean(errors**2)))
        good = [t for t in trials if t[0] >= GAIN and t[1] < base]
        if not good:
            break
        _, total, column, current, errors = max(good, key=lambda t: t[0])
        steps.append((column, total))
        left = [(rows, c) for rows, c in left if c != column]
    after = float(np.sqrt(np.mean(errors**2)))
    return ColumnSelection(tuple(sorted(current)), tuple(steps), before, after)


def _weights(folds: Sequence[Sequence[FoldedRow]]) -> Array:
    """1 / |b| of each row over all folds' training parts."""
    sizes = np.array([[np.linalg.norm(row.train[:, -1]) for row in fold] for fold in folds])
    total = np.sqrt((sizes**2).sum(axis=0))
    return np.where(total > 0, 1.0 / np.where(total > 0, total, 1.0), 0.0)


def _gram(fold: Sequence[FoldedRow], weights: Array) -> Array:
    """[W | b]' [W | b] of a fold's training part, rows weighted."""
    return sum(  # type: ignore[return-value]
        (weight**2 * row.train.T @ row.train for row, weight in zip(fold, weights, strict=True)),
        start=np.zeros((fold[0].train.shape[1],) * 2),
    )


def _errors(
    folds: Sequence[Sequence[FoldedRow]], grams: Sequence[Array], columns: Sequence[int]
) -> Array:
    """Relative error (rows,) on the left-out parts of all folds together."""
    errors = np.zeros(len(folds[0]))
    sizes = np.zeros(len(folds[0]))
    at = np.array(columns)
    for fold, gram in zip(folds, grams, strict=True):
        beta = _solve(gram, at)
        for i, row in enumerate(fold):
            errors[i] += np.sum((row.test[:, at] @ beta - row.test[:, -1]) ** 2)
            sizes[i] += np.sum(row.test[:, -1] ** 2)
    return np.sqrt(errors / np.where(sizes > 0, sizes, 1.0))


def _solve(gram: Array, at: Array) -> Array:
    A, b = gram[np.ix_(at, at)], gram[at, -1]
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    A = A / np.outer(scale, scale) + RIDGE * np.eye(len(at))
    return np.linalg.solve(A, b / scale) / scale
