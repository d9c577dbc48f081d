"""Torque errors of an estimate on held-out motions or test recordings: one code for both.

Samples of all motions are pooled. Relative errors are divided by the RMS of the whole torque of the
same row over the same samples.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from sysid_bench.identification.linear.least_squares import residual_norm, stacked_factor
from sysid_bench.types import Array, Problem

SMALL_JOINT: Final = 0.01
"""A row whose RMS torque is below this fraction of the largest of its kind is left out of the
means. Forces and torques, of joints and of a floating base, are kinds of their own
(`Problem.kinds`)."""

ROUNDING: Final = 1e-12
"""A row whose RMS torque is below this fraction of the largest of all rows is a rounding error."""

UNTESTED: Final = {"rmse_test": None, "rms": None, "relative": None, "small": True}
"""Fields of a joint without held-out motions."""


def row_rms(problems: list[Problem]) -> Array:
    """RMS torque of each row (rows,) over all samples, known contributions included; zero where it
    is a rounding error."""
    # Sums of squares are pooled, not RMS values: motions count by their samples.
    squares = np.array([_row_counts(problem) * _torque(problem) ** 2 for problem in problems])
    rms = np.sqrt(squares.sum(axis=0) / _all_counts(problems))
    return np.where(rms > ROUNDING * rms.max(initial=0.0), rms, 0.0)


def _row_counts(problem: Problem) -> Array:
    """Return the samples of each row (rows,), at least 1: rows at standstill may be left out."""
    return np.array([max(factor.samples, 1) for factor in problem.factors])


def _all_counts(problems: list[Problem]) -> Array:
    return np.asarray(sum(_row_counts(problem) for problem in problems))


def _torque(problem: Problem) -> Array:
    """RMS torque of each row (rows,) of one problem."""
    if problem.torque is not None:
        return problem.torque
    # The last column of R is Q'b, which has the norm of b: Q is orthogonal.
    norms = np.array([np.linalg.norm(factor.R[:, -1]) for factor in problem.factors])
    return np.asarray(norms / np.sqrt(_row_counts(problem)))


def loaded_joints(rms: Array, kinds: Sequence[str]) -> Array:
    """Return the mask (rows,) of the rows whose RMS torques (rows,) are large enough to count in
    means, each among those of its kind."""
    # The relative error of a joint that carries hardly any torque is that of its noise.
    large, names = np.zeros(len(rms), dtype=bool), np.array(kinds)
    for kind in dict.fromkeys(kinds):
        of_kind = names == kind
        large[of_kind] = rms[of_kind] >= SMALL_JOINT * rms[of_kind].max()
    return np.asarray(large & (rms > 0))


def mean_torque_error(problem: Problem, tests: list[Problem]) -> float | None:
    """Return the `torque_error` on tests of predicting the mean torque of each row in the training
    data; None where a problem does not state its torque."""
    if problem.mean is None or not tests:
        return None
    squares = np.zeros(len(problem.rows))
    for test in tests:
        if test.torque is None or test.mean is None:
            return None
        # sum (tau - m)^2 from the sums of tau and tau^2: no sample is read again.
        of_row = test.torque**2 - 2 * problem.mean * test.mean + problem.mean**2
        squares += _row_counts(test) * np.maximum(of_row, 0.0)
    rms = row_rms(tests)
    loaded = loaded_joints(rms, tests[0].kinds or ("",) * len(rms))
    loaded &= [len(factor.columns) > 0 for factor in tests[0].factors]
    shares = squares[loaded] / _all_counts(tests)[loaded] / rms[loaded] ** 2
    return float(np.sqrt(shares.mean())) if loaded.any() else None


@dataclass(frozen=True, eq=False)
class RowErrors:
    """Torque errors of `beta` on each row (rows,), over the samples of all `problems`."""

    problems: list[Problem]
    beta: Array

    @cached_property
    def errors(self) -> Array:
        """RMS error."""
        squares = np.array([residual_norm(p, self.beta) ** 2 for p in self.problems])
        return np.asarray(np.sqrt(squares.sum(axis=0) / _all_counts(self.problems)))

    @cached_property
    def rms(self) -> Array:
        """RMS torque."""
        return row_rms(self.problems)

    @cached_property
    def loaded_rows(self) -> Array:
        """Mask of the rows with enough torque to count in means."""
        return loaded_joints(self.rms, self._names)

    @property
    def _names(self) -> Sequence[str]:
        """Kind of each row."""
        return self.problems[0].kinds or ("",) * len(self.rms)

    @cached_property
    def _kinds(self) -> list[Array]:
        """Mask of the rows of each kind: only their torques have a common unit."""
        names = np.array(self._names)
        return [names == kind for kind in dict.fromkeys(names)]

    @cached_property
    def relative(self) -> Array:
        """RMS error over RMS torque; NaN where no unknown or no torque acts."""
        defined = np.array([len(factor.columns) > 0 for factor in self.problems[0].factors])
        defined &= self.rms > 0
        return np.where(defined, self.errors / np.where(defined, self.rms, 1.0), np.nan)

    def relative_of(self, i: int) -> float | None:
        """Return the relative error of row i; None where it has none."""
        return float(self.relative[i]) if np.isfinite(self.relative[i]) else None

    @cached_property
    def loaded_errors(self) -> Array:
        """Relative errors of the rows in `loaded_rows`."""
        return np.asarray(self.relative[self.loaded_rows & np.isfinite(self.relative)])

    @property
    def rms_error(self) -> float:
        """RMS of all rows' errors."""
        return float(np.sqrt((self.errors**2).mean()))

    @property
    def torque_error(self) -> float | None:
        """RMS of the judged relative errors."""
        return float(np.sqrt((self.loaded_errors**2).mean())) if len(self.loaded_errors) else None

    @property
    def rms_by_torque(self) -> float | None:
        """RMS of the relative errors with each joint weighted by its RMS torque; kinds of rows,
        whose torques have no common unit, count equally."""
        rows = [kind & np.isfinite(self.relative) for kind in self._kinds]
        squares = [
            # Weights by the torque: a wrist with friction of 1.5 N m would else make most of an
            # arm's error.
            np.average(self.relative[part] ** 2, weights=self.rms[part])
            for part in rows
            if part.any()
        ]
        return float(np.sqrt(np.mean(squares))) if squares else None

    @property
    def largest(self) -> float | None:
        """Largest judged relative error."""
        return float(self.loaded_errors.max()) if len(self.loaded_errors) else None


def least_torque_error(tests: Sequence[Problem]) -> float | None:
    """Return the least `torque_error` that any base parameters have on the tests: that of those
    which fit the tests themselves, each row divided by its RMS torque."""
    judged = RowErrors(list(tests), np.zeros(tests[0].base.rank))
    scale = judged.rms * np.sqrt(_all_counts(judged.problems))
    # Rows that do not count in the error have no weight.
    weights = np.where(judged.loaded_rows, 1.0 / np.where(scale > 0, scale, 1.0), 0.0).tolist()
    R = np.concatenate([stacked_factor(test, weights) for test in tests])
    norms = np.linalg.norm(R[:, :-1], axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    # Directions that the tests do not excite do not matter to them.
    beta = np.linalg.lstsq(R[:, :-1] / norms, R[:, -1])[0] / norms
    return RowErrors(judged.problems, beta).torque_error


def torque_figures(
    tests: Mapping[str, Problem], moving: Mapping[str, Problem], beta: Array
) -> dict[str, Any]:
    """Return the errors on test problems and on the same without rows at standstill, as fields of
    Score; {} without tests."""
    figures: dict[str, Any] = {}
    if tests:
        test = RowErrors(list(tests.values()), beta)
        figures = {
            "rmse_test": test.rms_error,
            "torque_error": test.torque_error,
            "torque_error_weighted": test.rms_by_torque,
            "torque_error_worst": test.largest,
            "torque_error_by_motion": {
                name: RowErrors([problem], beta).torque_error for name, problem in tests.items()
            },
        }
    if moving:
        errors = RowErrors(list(moving.values()), beta)
        figures["torque_error_moving"] = errors.torque_error
    return figures


def joint_figures(
    problem: Problem, tests: Mapping[str, Problem], beta: Array
) -> Iterator[dict[str, Any]]:
    """Yield the errors of each row in training and on the tests."""
    train = RowErrors([problem], beta)
    test = RowErrors(list(tests.values()), beta) if tests else None
    for i, name in enumerate(problem.rows):
        held_out = (
            UNTESTED
            if test is None
            else {
                "rmse_test": float(test.errors[i]),
                "rms": float(test.rms[i]),
                "relative": test.relative_of(i),
                "small": not bool(test.loaded_rows[i]),
            }
        )
        yield {"name": name, "rmse_train": float(train.errors[i]), **held_out}


def rms(values: ArrayLike) -> float:
    """Return the root mean square of an array of any shape; NaN if it is empty."""
    values = np.asarray(values)
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


def known_rms(values: Iterable[float | None]) -> float | None:
    """Return the root mean square of those values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return rms(known) if known else None
