"""Selection of terms and features by cross-validation within the training motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sysid_bench.experiments.recorded.extra_columns import extra_columns, is_motor
from sysid_bench.experiments.recorded.preprocess import Preprocessing, ProcessedLog
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, fold_factors
from sysid_bench.experiments.recorded.unknowns import Unknowns
from sysid_bench.identification.linear.column_selection import FoldRow, select_columns
from sysid_bench.identification.linear.normal_qr import spread
from sysid_bench.models.manifest import is_term
from sysid_bench.qr_factor import upper_factor
from sysid_bench.signals.time_folds import time_folds

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
    preprocessing: Preprocessing,
) -> tuple[Unknowns, TermSelection]:
    """The unknowns with those candidates that improve the prediction of left-out parts.

    Parts are stretches of the period where the motion is periodic, of time otherwise, so that no
    other period shows a left-out part.
    """
    wide = _with_candidates(unknowns, candidates, training)
    names = wide.base().names
    folds = _folds(LogProblemBuilder(wide, names, preprocessing), training)
    known = {*unknowns.inertial, *unknowns.terms, *unknowns.payload_parameters, *unknowns.extra}
    start = [i for i, name in enumerate(names) if name in known]
    optional = [
        (tuple(unknowns.rows.index(row) for row in wide.rows_of(name) if row in unknowns.rows), i)
        for i, name in enumerate(names)
        if name not in known
    ]
    choice = select_columns(folds, start, [(rows, i) for rows, i in optional if rows])
    added = {names[i] for i in choice.columns} - known
    selection = TermSelection(
        tuple((names[i], error) for i, error in choice.steps),
        choice.error_before,
        choice.error_after,
        time_folds(training[0].recording.motion, FOLDS)[1],
    )
    terms, extra = set(unknowns.terms), set(unknowns.extra)
    selected = replace(
        wide,
        terms=tuple(name for name in wide.terms if name in terms | added),
        extra=tuple(name for name in wide.extra if name in extra | added),
    )
    return selected, selection


def _with_candidates(
    unknowns: Unknowns, candidates: tuple[str, ...], training: Sequence[ProcessedLog]
) -> Unknowns:
    """The unknowns with all candidates; of motors those that share joints, since the columns of a
    motor that drives one joint alone are those of that joint."""
    terms = tuple(name for name in candidates if is_term(name) and not is_motor(name))
    more = [
        column
        for column in unknowns.robot.term_columns(terms)
        if column.split(".")[0] in unknowns.rows
    ]
    words = [name for name in candidates if name not in terms]
    table = extra_columns(unknowns.robot, unknowns.rows, (*unknowns.motor_words, *words), training)
    coupled = () if table.motors is None else table.motors.coupled
    return replace(
        unknowns,
        terms=tuple(dict.fromkeys([*unknowns.terms, *more])),
        features=table,
        extra=tuple(dict.fromkeys([*unknowns.extra, *table.joints.columns, *coupled])),
    )


def _folds(builder: LogProblemBuilder, training: Sequence[ProcessedLog]) -> list[list[FoldRow]]:
    """Training and left-out rows of each part and joint."""
    width = len(builder.columns)
    left_out = [
        [upper_factor(spread(factor, width) for factor in factors) for factors in part]
        for part in fold_factors(builder, training, FOLDS)
    ]
    return [
        [
            FoldRow(
                upper_factor(left_out[other][k] for other in range(FOLDS) if other != f),
                left_out[f][k],
            )
            for k in range(len(builder.unknowns.rows))
        ]
        for f in range(FOLDS)
    ]
