"""Selection of terms and features by cross-validation within the training motion."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

from sysid_bench.experiments.recorded.extra_columns import (
    columns_of_features,
    extra_columns,
    plugin_folder,
)
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, fold_factors
from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.experiments.recorded.unknowns import Unknowns
from sysid_bench.experiments.tasks.task import words_of_features
from sysid_bench.identification.linear.column_selection import FoldRow, select_columns
from sysid_bench.identification.linear.normal_qr import spread
from sysid_bench.qr_factor import qr_factor
from sysid_bench.signals.time_fold import time_fold
from sysid_bench.types import Array, Factor

FOLDS: Final = 5
"""Parts of a motion for cross-validation."""


@dataclass(frozen=True)
class TermSelection:
    """Columns that cross-validation added, each with the error after it (mean relative, on left-out
    parts), the error before and after all, and the kind of parts."""

    added: tuple[tuple[str, float], ...]
    error_before: float
    error_after: float
    parts: str


def select_terms(
    unknowns: Unknowns,
    candidates: tuple[str, ...],
    training: Sequence[ProcessedLog],
    preprocessing: LogProcessing,
) -> tuple[Unknowns, TermSelection]:
    """The unknowns with those candidates that improve the prediction of left-out parts.

    Parts are stretches of the period where the motion is periodic, of time otherwise, so that no
    other period shows a left-out part.
    """
    wide = _with_candidates(unknowns, candidates, training)
    names = wide.base().names
    # Factors of all candidates once: the search only takes columns of them.
    folds = _folds(LogProblemBuilder(wide, names, preprocessing), training)
    known = {*unknowns.robot_parameters, *unknowns.payload_parameters, *unknowns.extra}
    start = [i for i, name in enumerate(names) if name in known]
    optional = [(_row_indices(wide, name), i) for i, name in enumerate(names) if name not in known]
    choice = select_columns(folds, start, [(rows, i) for rows, i in optional if rows])
    added = {names[i] for i in choice.columns} - known
    selection = TermSelection(
        tuple((names[i], error) for i, error in choice.steps),
        choice.error_before,
        choice.error_after,
        time_fold(training[0].recording.motion, FOLDS)[1],
    )
    selected = replace(
        wide,
        terms=_selected(wide.terms, added.union(unknowns.terms)),
        extra=_selected(wide.extra, added.union(unknowns.extra)),
    )
    return selected, selection


def _row_indices(unknowns: Unknowns, name: str) -> tuple[int, ...]:
    """Indices of the recorded rows in which a term or feature acts."""
    rows = unknowns.rows
    return tuple(rows.index(row) for row in unknowns.rows_of(name) if row in rows)


def _selected(names: Sequence[str], wanted: Collection[str]) -> tuple[str, ...]:
    """Those names that are wanted, in their own order."""
    return tuple(name for name in names if name in wanted)


def _with_candidates(
    unknowns: Unknowns, candidates: tuple[str, ...], training: Sequence[ProcessedLog]
) -> Unknowns:
    """The unknowns with all candidates; of motors those that share joints, since the columns of a
    motor that drives one joint alone are those of that joint."""
    robot, rows = unknowns.robot, unknowns.rows
    words = words_of_features(candidates, robot)
    columns = robot.term_columns(tuple(name for name in candidates if name not in words))
    more = [column for column in columns if column.split(".")[0] in rows]
    table = extra_columns(robot, rows, unknowns.words, training, candidates=words)
    named = columns_of_features(words, rows, plugin_folder(robot), several=True)
    coupled = () if table.motors is None else table.motors.coupled
    return replace(
        unknowns,
        terms=tuple(dict.fromkeys([*unknowns.terms, *more])),
        features=table,
        extra=tuple(dict.fromkeys([*unknowns.extra, *named, *coupled])),
    )


def _folds(builder: LogProblemBuilder, training: Sequence[ProcessedLog]) -> list[list[FoldRow]]:
    """Training and left-out rows of each part and joint."""
    width = len(builder.columns)
    parts = [
        [_joined(factors, width) for factors in part]
        for part in fold_factors(builder, training, FOLDS)
    ]
    return [_fold(parts[:f] + parts[f + 1 :], parts[f]) for f in range(FOLDS)]


def _joined(factors: Sequence[Factor], width: int) -> Array:
    """One triangular factor (m, width + 1) of the rows of a joint in all logs."""
    return qr_factor(spread(factor, width) for factor in factors)


def _fold(training: Sequence[Sequence[Array]], left_out: Sequence[Array]) -> list[FoldRow]:
    """The rows of each joint, of the training parts together and of the part left out."""
    by_row = zip(*training, strict=True)
    return [FoldRow(qr_factor(R), last) for R, last in zip(by_row, left_out, strict=True)]
