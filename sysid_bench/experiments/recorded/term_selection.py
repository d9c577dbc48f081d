"""Terms and features that predict parts of the training motion which were left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sysid_bench.experiments.recorded.extra_columns import extra_columns, is_motor
from sysid_bench.experiments.recorded.preprocess import Preprocessing, ProcessedLog
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, fold_factors
from sysid_bench.experiments.recorded.unknowns import Unknowns
from sysid_bench.identification.linear.column_selection import FoldedRow, select_columns
from sysid_bench.identification.linear.normal_qr import spread
from sysid_bench.models.manifest import is_term
from sysid_bench.regressors.qr_accumulation import upper_factor
from sysid_bench.signals.time_folds import time_folds

FOLDS: Final = 5
"""Parts of a motion for cross-validation."""


@dataclass(frozen=True)
class TermSelection:
    """What cross-validation added: the error (mean relative, on left-out parts) before, and after
    each column; how the parts were made."""

    added: tuple[tuple[str, float], ...]
    error_before: float
    error_after: float
    parts: str


def select_terms(
    ask: Unknowns,
    candidates: tuple[str, ...],
    training: Sequence[ProcessedLog],
    treatment: Preprocessing,
) -> tuple[Unknowns, TermSelection]:
    """The question with the candidates that predict parts of the training motion left out of it.

    Parts are stretches of the period where the motion repeats itself, of time otherwise: what is
    left out is never seen at another time.
    """
    wide = _widened(ask, candidates, training)
    names = wide.base().names
    folds = _folds(LogProblemBuilder(wide, names, treatment), training)
    known = {*ask.inertial, *ask.terms, *ask.payload_parameters, *ask.extra}
    start = [i for i, name in enumerate(names) if name in known]
    found = [
        (tuple(ask.rows.index(row) for row in wide.rows_of(name) if row in ask.rows), i)
        for i, name in enumerate(names)
        if name not in known
    ]
    choice = select_columns(folds, start, [(rows, i) for rows, i in found if rows])
    added = {names[i] for i in choice.columns} - known
    selection = TermSelection(
        tuple((names[i], error) for i, error in choice.steps),
        choice.error_before,
        choice.error_after,
        time_folds(training[0].recording.motion, FOLDS)[1],
    )
    own, more = set(ask.terms), set(ask.extra)
    chosen = replace(
        wide,
        terms=tuple(name for name in wide.terms if name in own | added),
        extra=tuple(name for name in wide.extra if name in more | added),
    )
    return chosen, selection


def _widened(
    ask: Unknowns, candidates: tuple[str, ...], training: Sequence[ProcessedLog]
) -> Unknowns:
    """The question with every candidate; of motors those that share joints, since what one drives
    alone its joint has columns of."""
    terms = tuple(name for name in candidates if is_term(name) and not is_motor(name))
    more = [c for c in ask.robot.term_columns(terms) if c.split(".")[0] in ask.rows]
    words = [name for name in candidates if name not in terms]
    table = extra_columns(ask.robot, ask.rows, (*ask.motor_words, *words), training)
    coupled = () if table.motors is None else table.motors.coupled
    return replace(
        ask,
        terms=tuple(dict.fromkeys([*ask.terms, *more])),
        features=table,
        extra=tuple(dict.fromkeys([*ask.extra, *table.joints.columns, *coupled])),
    )


def _folds(posing: LogProblemBuilder, training: Sequence[ProcessedLog]) -> list[list[FoldedRow]]:
    """Of each part left out and each joint, what is trained on and what is left out."""
    width = len(posing.columns)
    left_out = [
        [upper_factor(spread(factor, width) for factor in own) for own in part]
        for part in fold_factors(posing, training, FOLDS)
    ]
    return [
        [
            FoldedRow(
                upper_factor(left_out[other][k] for other in range(FOLDS) if other != f),
                left_out[f][k],
            )
            for k in range(len(posing.unknowns.rows))
        ]
        for f in range(FOLDS)
    ]
