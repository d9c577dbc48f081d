"""Forward selection of regressor columns by cross-validation.

It uses the training data alone. The QR factors of each fold are computed once with all candidate
columns; a subset of columns is a subset of the columns of these factors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.types import Array

GAIN: Final = 0.02
"""Least relative reduction of a joint's validation error by an added column."""

RIDGE: Final = 1e-9
"""Ridge weight on unit columns: bounds directions that a fold does not excite."""


@dataclass(frozen=True, eq=False)
class FoldRow:
    """One row (joint) in one fold: factors R (k + 1, k + 1) of [W | b] of the training and the
    validation part, with all candidate columns."""

    train: Array
    test: Array


@dataclass(frozen=True, eq=False)
class ColumnSelection:
    """Indices of the chosen columns, and (column, mean error after adding it) of each step."""

    columns: tuple[int, ...]
    steps: tuple[tuple[int, float], ...]
    error_before: float
    error_after: float


def select_columns(
    folds: Sequence[Sequence[FoldRow]],
    start: Sequence[int],
    candidates: Sequence[tuple[Sequence[int], int]],
) -> ColumnSelection:
    """Forward selection: add the candidate (rows, column) that reduces the error of one of its rows
    most, until none reduces any by GAIN. `folds[f][i]` is row i in fold f.

    Rows are weighted by their RMS torque in training, so that each counts alike.
    """
    sizes = np.array([[np.linalg.norm(row.train[:, -1]) for row in fold] for fold in folds])
    total = np.sqrt((sizes**2).sum(axis=0))
    weights = np.where(total > 0, 1.0 / np.where(total > 0, total, 1.0), 0.0)
    grams = []  # normal matrices [W | b]' [W | b] of the training parts, rows weighted
    for fold in folds:
        parts = [w**2 * row.train.T @ row.train for row, w in zip(fold, weights, strict=True)]
        grams.append(sum(parts, start=np.zeros((fold[0].train.shape[1],) * 2)))
    current = list(start)
    errors = _errors(folds, grams, current)
    before = _rms(errors)
    steps: list[tuple[int, float]] = []
    left = list(candidates)
    while left:
        trials = [
            _Trial(rows, column, errors, _errors(folds, grams, [*current, column]))
            for rows, column in left
        ]
        good = [trial for trial in trials if trial.improves]
        if not good:
            break
        best = max(good, key=lambda trial: trial.gain)
        current, errors = [*current, best.column], best.after
        steps.append((best.column, _rms(errors)))
        left = [(rows, column) for rows, column in left if column != best.column]
    return ColumnSelection(tuple(sorted(current)), tuple(steps), before, _rms(errors))


@dataclass(frozen=True, eq=False)
class _Trial:
    """Errors (rows,) before and after adding one column, which acts on some `rows`."""

    rows: Sequence[int]
    column: int
    before: Array
    after: Array

    @property
    def gain(self) -> float:
        """Largest relative reduction of the error of a row that the column acts on."""
        rows = list(self.rows)
        return float(np.max(1.0 - self.after[rows] / self.before[rows]))

    @property
    def improves(self) -> bool:
        return self.gain >= GAIN and _rms(self.after) < _rms(self.before)


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _errors(
    folds: Sequence[Sequence[FoldRow]], grams: Sequence[Array], columns: Sequence[int]
) -> Array:
    """Relative error (rows,) on the validation parts of all folds."""
    errors = np.zeros(len(folds[0]))
    sizes = np.zeros(len(folds[0]))
    selected = np.array(columns)
    for fold, gram in zip(folds, grams, strict=True):
        # Normal equations suffice: the errors that are compared are far above their rounding.
        A, b = gram[np.ix_(selected, selected)], gram[selected, -1]
        # Unit columns: the ridge then means the same for every unit.
        scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
        A = A / np.outer(scale, scale) + RIDGE * np.eye(len(selected))
        beta = np.linalg.solve(A, b / scale) / scale
        for i, row in enumerate(fold):
            errors[i] += np.sum((row.test[:, selected] @ beta - row.test[:, -1]) ** 2)
            sizes[i] += np.sum(row.test[:, -1] ** 2)
    return np.sqrt(errors / np.where(sizes > 0, sizes, 1.0))
