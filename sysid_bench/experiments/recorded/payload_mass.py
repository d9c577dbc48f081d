"""Mass of a payload whose position is given, with a confidence interval."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Final

import numpy as np
from scipy.special import stdtrit

from sysid_bench.errors import EstimationError
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.experiments.pooled_problem import row_factor
from sysid_bench.experiments.recorded.preprocess import ProcessedLog
from sysid_bench.experiments.recorded.problem import (
    LogProblemBuilder,
    fold_factors,
)
from sysid_bench.experiments.recorded.term_selection import FOLDS
from sysid_bench.experiments.recorded.unknowns import MASS
from sysid_bench.identification.identify import identify
from sysid_bench.types import Array, Factor, Problem

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
    index = problem.base.names.index(MASS)
    masses = [
        float(_identified(method, part)[index])
        for part in _leave_one_fold_out(problem, builder, training)
    ]
    n = len(masses)
    # The jackknife inflates the scatter by (n - 1)^2: estimates that share most data differ little.
    std = float(np.sqrt((n - 1) / n * np.sum((np.array(masses) - np.mean(masses)) ** 2)))
    mass = float(beta[index])
    half_width = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2)) * std
    return PayloadMass(mass, std, (mass - half_width, mass + half_width), tuple(masses))


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
    return [
        replace(problem, factors=_joined_factors(parts[:left_out] + parts[left_out + 1 :]))
        for left_out in range(FOLDS)
    ]


def _joined_factors(parts: Sequence[Sequence[Sequence[Factor]]]) -> tuple[Factor, ...]:
    """One factor of each row, over all parts and logs."""
    return tuple(row_factor([*chain.from_iterable(row)]) for row in zip(*parts, strict=True))
