"""Variants of an identification problem with a known relation between their solutions."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from sysid_bench.types import Array, Factor, Prior, Problem, RowBlock

# `replace` makes a new object each time, so that the cached `Problem.stacked` is not inherited.


def scaled_problem(problem: Problem, regressor: float = 1.0, torque: float = 1.0) -> Problem:
    """The problem (regressor W) beta = torque b, in R factors and blocks alike."""
    factors = tuple(
        replace(f, R=f.R * np.append(np.full(len(f.columns), regressor), torque))
        for f in problem.factors
    )
    blocks = partial(_scaled, problem.blocks, regressor, torque)
    return replace(problem, factors=factors, blocks=blocks)


def scaled_prior(problem: Problem, factor: float) -> Problem:
    """The problem with its prior mean and standard deviations times `factor`."""
    if problem.prior is None:
        return problem
    return replace(problem, prior=Prior(factor * problem.prior.theta, factor * problem.prior.std))


def rows_from_end(problem: Problem) -> Problem:
    """The problem with its rows (joints) in reverse order."""
    return replace(
        problem,
        rows=problem.rows[::-1],
        factors=problem.factors[::-1],
        kinds=problem.kinds[::-1],
        blocks=partial(_reversed, problem.blocks),
    )


def first_samples(problem: Problem, samples: int) -> Problem:
    """The problem of the first `samples` samples."""
    Y, b = next(iter(problem.blocks()))
    Y, b = Y[:samples].copy(), b[:samples].copy()
    factors = []
    for i, factor in enumerate(problem.factors):
        # R of [W b] holds all that least squares need: R^T R = [W b]^T [W b].
        stack = np.column_stack([Y[:, i, factor.columns], b[:, i]])
        R = np.asarray(np.linalg.qr(stack, mode="r"))
        factors.append(Factor(factor.row, factor.columns, R, len(b)))
    blocks = partial(_one_block, Y, b)
    return replace(problem, factors=tuple(factors), blocks=blocks, samples=len(b))


def _scaled(
    blocks: Callable[[], Iterator[RowBlock]], regressor: float, torque: float
) -> Iterator[RowBlock]:
    for Y, b in blocks():
        yield regressor * Y, torque * b


def _reversed(blocks: Callable[[], Iterator[RowBlock]]) -> Iterator[RowBlock]:
    for Y, b in blocks():
        yield Y[:, ::-1], b[:, ::-1]


def _one_block(Y: Array, b: Array) -> Iterator[RowBlock]:
    yield Y, b
