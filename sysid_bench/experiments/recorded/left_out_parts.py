"""Parts of a training motion left out: selection of terms, and problems without each part."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

from sysid_bench.experiments.processed_rows import row_factor
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
from sysid_bench.identification.linear.least_squares import spread
from sysid_bench.numerics import qr_factor
from sysid_bench.signals.spectrum import time_fold
from sysid_bench.types import Problem

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
    builder, width = LogProblemBuilder(wide, names, preprocessing), len(names)
    folds = list(_folds(builder, training, width))
    known = {*unknowns.robot_parameters, *unknowns.payload_parameters, *unknowns.extra}
    start = [i for i, name in enumerate(names) if name in known]
    choice = select_columns(folds, start, list(_optional_columns(wide, names, known)))
    added = {names[i] for i in choice.columns} - known
    selection = TermSelection(
        tuple((names[i], error) for i, error in choice.steps),
        choice.error_before,
        choice.error_after,
        time_fold(training[0].recording.motion, FOLDS)[1],
    )
    terms, extra = added.union(unknowns.terms), added.union(unknowns.extra)
    selected = replace(
        wide,
        terms=tuple(name for name in wide.terms if name in terms),
        extra=tuple(name for name in wide.extra if name in extra),
    )
    return selected, selection


def _folds(
    builder: LogProblemBuilder, training: Sequence[ProcessedLog], width: int
) -> Iterator[list[FoldRow]]:
    """Yield the rows of each joint, of the other parts together and of the part left out."""
    parts = [
        [qr_factor(spread(factor, width) for factor in factors) for factors in part]
        for part in fold_factors(builder, training, FOLDS)
    ]
    for f, left_out in enumerate(parts):
        others = zip(*(parts[:f] + parts[f + 1 :]), strict=True)
        yield [FoldRow(qr_factor(R), last) for R, last in zip(others, left_out, strict=True)]


def _optional_columns(
    wide: Unknowns, names: Sequence[str], known: Collection[str]
) -> Iterator[tuple[tuple[int, ...], int]]:
    """Yield the candidates: the recorded rows in which a term or feature acts, and its column."""
    for i, name in enumerate(names):
        rows = tuple(wide.rows.index(row) for row in wide.rows_of(name) if row in wide.rows)
        if name not in known and rows:
            yield rows, i


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


def leave_one_fold_out(
    problem: Problem, builder: LogProblemBuilder, training: Sequence[ProcessedLog]
) -> list[Problem]:
    """The training problem without each part of every motion in turn."""
    parts = fold_factors(builder, training, FOLDS)
    problems = []
    for left_out in range(FOLDS):
        others = parts[:left_out] + parts[left_out + 1 :]
        rows = zip(*others, strict=True)
        factors = tuple(row_factor([*chain.from_iterable(row)]) for row in rows)
        problems.append(replace(problem, factors=factors))
    return problems
