"""Parts of a training motion left out: selection of terms, and intervals of payloads."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.evaluation.intervals import confidence_level, coverage_factor, jackknife_std
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.experiments.processed_rows import row_factor
from sysid_bench.experiments.recorded.extra_columns import (
    columns_of_features,
    extra_columns,
    plugin_folder,
)
from sysid_bench.experiments.recorded.problem import LogProblemBuilder, fold_factors
from sysid_bench.experiments.recorded.process_log import LogProcessing, ProcessedLog
from sysid_bench.experiments.recorded.unknowns import MASS, Unknowns
from sysid_bench.experiments.tasks.task import words_of_features
from sysid_bench.identifiability.base_expressions import parameter_verdict
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.column_selection import FoldRow, select_columns
from sysid_bench.identification.linear.least_squares import spread
from sysid_bench.numerics import qr_factor
from sysid_bench.signals.spectrum import time_fold
from sysid_bench.spatial import body_mass_inertia, inertia_values
from sysid_bench.types import Array, Factor, Problem

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


SEPARATE: Final = 1e-3
"""Share of the payload's column of a row that the other columns must leave, for a mass there."""

ROUNDING: Final = 1e-12
"""Share of the largest column of a row below which a column is a rounding error."""

SMALLEST: Final = 1e-6
"""Share of the largest deviation of the joints that each has at least: along the axis of a joint a
load may have no torque at all, and the weights of the others would be lost in rounding."""


@dataclass(frozen=True)
class PayloadMass:
    """kg; `parts`: the mass with each part of the motion left out; `by_joint`: the mass that the
    torque of one joint alone gives, with its deviation. They are equal up to noise if all torques
    have the right scale."""

    mass: float
    std: float
    interval: tuple[float, float]
    parts: tuple[float, ...]
    confidence: float
    by_joint: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def payload_mass(
    method: Any,
    problem: Problem,
    builder: LogProblemBuilder,
    training: Sequence[ProcessedLog],
    beta: Array,
) -> PayloadMass:
    """The mass in `beta` (r,), its deviation by the jackknife over parts of the motion (Tukey
    1958) and by the disagreement of the joints, and the interval of Student's t.

    Residuals are not white: a formal deviation would be too small by an order of magnitude. Raises
    EstimationError where the method fails without one of the parts.
    """
    index = problem.base.names.index(MASS)
    parts = _leave_one_fold_out(problem, builder, training)
    masses = [float(_identified(method, part)[index]) for part in parts]
    by_joint = {}
    for i, row in enumerate(problem.rows):
        values = np.array([_row_mass(one.factors[i], index) for one in (problem, *parts)])
        # No mass of its own where the row's other unknowns explain the payload's torque as well.
        if np.isfinite(values).all():
            by_joint[row] = (float(values[0]), float(jackknife_std(values[1:, None])[0][0]))
    spread, freedom = jackknife_std(np.array(masses)[:, None])
    std = float(np.sqrt(spread[0] ** 2 + _disagreement(by_joint)))
    mass, factor = float(beta[index]), coverage_factor(freedom)
    interval = (mass - factor * std, mass + factor * std)
    return PayloadMass(mass, std, interval, tuple(masses), confidence_level(), by_joint)


def _disagreement(by_joint: Mapping[str, tuple[float, float]]) -> float:
    """Variance (kg^2) that the mean over the joints has because they disagree by more than their
    deviations, as with errors of their torque scales (DerSimonian and Laird 1986)."""
    masses, std = np.array(list(by_joint.values())).reshape(-1, 2).T
    if len(masses) < 2 or not (std > 0).all():
        return 0.0
    std = np.maximum(std, SMALLEST * std.max())
    w = 1 / std**2
    excess = float(w @ (masses - w @ masses / w.sum()) ** 2) - (len(masses) - 1)
    between = max(excess, 0.0) / float(w.sum() - (w @ w) / w.sum())
    return float(1 / (1 / (std**2 + between)).sum() - 1 / w.sum())


def _row_mass(factor: Factor, index: int) -> float:
    """The mass in the fit of one row; NaN where it is not identifiable there."""
    at = np.flatnonzero(factor.columns == index)
    W, b = factor.R[:, :-1], factor.R[:, -1]
    scale = np.linalg.norm(W, axis=0)
    # A column that is zero up to rounding would be, at unit length, an unknown of random torque.
    acts = scale > ROUNDING * scale.max(initial=0.0)
    if len(at) == 0 or not acts[at[0]]:
        return float("nan")
    W = np.where(acts, W, 0.0) / np.where(acts, scale, 1.0)
    others = np.delete(W, at[0], axis=1)
    # The part of the mass column that the other unknowns of the row cannot take over.
    own = W[:, at[0]] - others @ np.linalg.lstsq(others, W[:, at[0]], rcond=None)[0]
    if np.linalg.norm(own) < SEPARATE:
        return float("nan")
    return float(own @ b / (own @ own) / scale[at[0]])


def payload_interval(
    method: Any,
    problem: Problem,
    builder: LogProblemBuilder,
    training: Sequence[ProcessedLog],
    beta: Array,
) -> dict[str, list[list[float]]]:
    """The intervals [low, high] of a payload with ten unknowns: `mass` (kg), `com` (m, 3) and
    `inertia` about it (kg m^2, 6), each where its parameters are identifiable on their own.

    By the jackknife of `payload_mass`, whose errors it has.
    """
    at = [problem.parameters.index(name) for name in builder.unknowns.payload_parameters]
    known = np.array(parameter_verdict(problem.base))[at] == "identifiable"
    fits = [_identified(method, part) for part in _leave_one_fold_out(problem, builder, training)]
    rows = []  # mass, centre of mass, inertia about it
    for one in (beta, *fits):
        mass, com, inertia = body_mass_inertia(problem.base.embed(one)[at])
        rows.append(np.concatenate([[mass], com, inertia_values(inertia)]))
    found = np.array(rows)
    std, freedom = jackknife_std(found[1:])
    reach = coverage_factor(freedom) * std
    ends = np.stack([found[0] - reach, found[0] + reach], axis=1)
    parts = {"mass": (slice(0, 1), 1), "com": (slice(1, 4), 4), "inertia": (slice(4, 10), 10)}
    return {
        name: ends[where].tolist()
        for name, (where, needed) in parts.items()
        if known[:needed].all() and found[0, 0] > 0
    }


def _identified(method: Any, part: Problem) -> Array:
    """Base parameters (r,) of the motion without a part; EstimationError where there are none."""
    estimate = identify(method, part)
    beta = base_parameters(estimate)
    if beta is None:
        raise EstimationError(f"With a part of the motion left out: {estimate.reason}")
    return beta


def _leave_one_fold_out(
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
