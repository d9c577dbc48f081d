"""Mass of a payload whose position is given, with a confidence interval."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.experiments.recorded.preprocess import ProcessedLog
from sysid_bench.experiments.recorded.problem import (
    LogProblemBuilder,
    fold_factors,
    row_factor,
)
from sysid_bench.experiments.recorded.term_selection import FOLDS
from sysid_bench.experiments.recorded.unknowns import MASS
from sysid_bench.identification.identify import identify
from sysid_bench.types import Array, Problem

CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class PayloadMass:
    """kg; `parts`: the mass with each part of the motion left out."""

    mass: float
    std: float
    interval: tuple[float, float]
    parts: tuple[float, ...]
    confidence: float = CONFIDENCE


def payload_mass(
    method: Any,
    problem: Problem,
    builder: LogProblemBuilder,
    training: Sequence[ProcessedLog],
    beta: Array,
) -> PayloadMass:
    """The mass in `beta` (r,), its deviation by the jackknife over parts of the motion (Tukey
    1958), and the interval of Student's t.

    Residuals are not white: a formal deviation would be too small by an order of magnitude. Raises
    EstimationError where the method fails without one of the parts.
    """
    from scipy.stats import t

    index = problem.base.names.index(MASS)
    masses = []
    for part in _leave_one_fold_out(problem, builder, training):
        estimate = identify(method, part)
        if estimate.status != "ok" or estimate.beta is None:
            raise EstimationError(f"With a part of the motion left out: {estimate.reason}")
        masses.append(float(estimate.beta[index]))
    n = len(masses)
    std = float(np.sqrt((n - 1) / n * np.sum((np.array(masses) - np.mean(masses)) ** 2)))
    mass = float(beta[index])
    half_width = float(t.ppf(0.5 + CONFIDENCE / 2, n - 1)) * std
    return PayloadMass(mass, std, (mass - half_width, mass + half_width), tuple(masses))


def _leave_one_fold_out(
    problem: Problem, builder: LogProblemBuilder, training: Sequence[ProcessedLog]
) -> list[Problem]:
    """The training problem without each part of every motion in turn."""
    parts = fold_factors(builder, training, FOLDS)
    return [
        replace(
            problem,
            factors=tuple(
                row_factor([R for f in range(FOLDS) if f != left_out for R in parts[f][k]])
                for k in range(len(problem.rows))
            ),
        )
        for left_out in range(FOLDS)
    ]
