"""Forward selection of regressor columns by cross-validation.

It uses the training data alone. The QR factors of each fold are computed once with all candidate
columns; a subset of columns is a subset of the columns of these factors.
"""

from collections.abc import Iterable, Sequence
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
        tried = ((rows, column, _errors(folds, grams, [*current, column])) for rows, column in left)
        best = _best_column(tried, errors)
        if best is None:
            break
        added, errors = best
        current.append(added)
        steps.append((added, _rms(errors)))
        left = [(rows, column) for rows, column in left if column != added]
    return ColumnSelection(tuple(sorted(current)), tuple(steps), before, _rms(errors))


def _best_column(
    tried: Iterable[tuple[Sequence[int], int, Array]], errors: Array
) -> tuple[int, Array] | None:
    """Column with the largest gain among (rows, column, errors with it), and these errors; None
    where none improves on the `errors` so far."""
    best, most = None, -np.inf
    for rows, column, after in tried:
        # Largest relative reduction of the error of a row that the column acts on.
        gain = float(np.max(1.0 - after[list(rows)] / errors[list(rows)]))
        # A column that serves one row and harms the others is none of the robot's.
        if gain >= GAIN and _rms(after) < _rms(errors) and gain > most:
            best, most = (column, after), gain
    return best


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
