"""One problem from those of several motions of the same robot."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, Factor, Problem, RowBlock


def pooled(problems: Sequence[Problem]) -> Problem:
    """Return the problem of all samples of some motions in order, which knows the single ones.

    All have the same unknowns and rows. The period is kept where all motions share it. One problem
    is returned as it is.
    """
    if len(problems) == 1:
        return problems[0]
    first = problems[0]
    periods = {problem.period for problem in problems}
    return replace(
        first,
        factors=tuple(row_factor(row) for row in zip(*(p.factors for p in problems), strict=True)),
        blocks=partial(_blocks, tuple(problems)),
        samples=sum(problem.samples for problem in problems),
        torque=_rms_torque(problems),
        period=first.period if len(periods) == 1 else 0,
        motions=tuple(problems),
    )


def row_factor(factors: Sequence[Factor]) -> Factor:
    """One factor of the same row of several recordings, which may have different columns."""
    if len(factors) == 1:
        return factors[0]
    columns = np.unique(np.concatenate([factor.columns for factor in factors]))
    padded = [_padded(factor, columns) for factor in factors]
    return Factor(factors[0].row, columns, qr_factor(padded), sum(f.samples for f in factors))


def _padded(factor: Factor, columns: Array) -> Array:
    """R of a factor with zero columns for those of the sorted `columns` that it lacks."""
    R = np.zeros((len(factor.R), len(columns) + 1))
    R[:, np.searchsorted(columns, factor.columns)] = factor.R[:, :-1]
    R[:, -1] = factor.R[:, -1]
    return R


def _blocks(problems: tuple[Problem, ...]) -> Iterator[RowBlock]:
    for problem in problems:
        yield from problem.blocks()


def _rms_torque(problems: Sequence[Problem]) -> Array | None:
    """RMS (rows,) of the whole torque over all motions; None where one does not state it."""
    squares, samples = np.zeros(len(problems[0].rows)), 0
    for problem in problems:
        if problem.torque is None:
            return None
        squares += problem.samples * problem.torque**2
        samples += problem.samples
    return np.asarray(np.sqrt(squares / max(samples, 1)))
