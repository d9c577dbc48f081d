"""Spread of an estimate over blocks of time, for methods that give no covariance of their own.

Feasible and regularised fits are not linear in the data: no formula of least squares is theirs. The
delete-a-group jackknife (Tukey 1958; Busing, Meijer, van der Leeden 1999) repeats the fit with each
block of time left out, constraints and prior included. A parameter that a constraint holds in every
fit does not move: its spread of zero is no deviation, and it has none.
"""

from typing import Any, Final

import numpy as np

from sysid_bench.evaluation.intervals import StandardError
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.cross_validation import time_blocks
from sysid_bench.types import Estimate, Problem

BLOCKS: Final = 8
"""Parts of the motion: a deviation from them is itself uncertain by a quarter."""

HELD: Final = 1e-7
"""Spread relative to the value below which a constraint holds a parameter in all fits: the
tolerance of the solvers."""


def block_errors(problem: Problem, estimate: Estimate, method: Any) -> StandardError | str:
    """Return the jackknife covariance of an estimate over blocks of time; or the reason why there
    is none.

    Its deviation is NaN for base parameters that a constraint holds. Samples of equal phase share a
    block (`time_blocks`).
    """
    if not hasattr(method, "solve"):
        return (
            "no ±: the method states no covariance, and leaving parts of the motion out would take "
            f"{BLOCKS} times its simulations"
        )
    if estimate.beta is None or problem.samples * len(problem.rows) < 4 * problem.base.rank:
        return "no ±: too few samples to leave parts of the motion out"
    parts, betas = time_blocks(problem, BLOCKS), []
    for label in range(BLOCKS):
        again = identify(method, parts.without(label))
        beta = base_parameters(again)
        if beta is None:
            return f"no ±: with a part of the motion left out there is no estimate: {again.reason}"
        betas.append(beta)
    moved = np.sqrt((BLOCKS - 1) / BLOCKS) * (np.array(betas) - np.mean(betas, axis=0))
    still = np.sqrt((moved**2).sum(axis=0)) <= HELD * np.abs(estimate.beta)
    moved[:, still] = np.nan
    return StandardError(moved.T @ moved, BLOCKS - 1)
