"""Spread of an estimate between different motions, which contains misfit.

A model error repeats itself in every period of a motion, and acts otherwise in another motion. The
jackknife over motions (cluster-robust covariance CV3; MacKinnon, Nielsen and Webb 2023) therefore
contains both noise and misfit. It does not contain what all motions share: the bias of a
gain, of a filter, of friction that the model lacks.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.evaluation.intervals import LEVEL, StandardError, coverage_factor
from sysid_bench.identification.linear.least_squares import (
    data_rank,
    residual_norm,
    solve_factor,
    stacked_factor,
)
from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, Estimate, Problem

ENOUGH_MOTIONS: Final = 5
"""Minimal number of motions: as few as for periods, and for the same reason."""


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Weighted least squares with each of M motions left out: `beta` (r,) of all motions, `betas`
    (M, r), and the RMS error (M, rows) of each on the motion that it has not seen."""

    beta: Array
    betas: Array
    errors: Array

    @property
    def _freedom(self) -> int:
        """Degrees of freedom of the spread between motions."""
        return len(self.betas) - 1

    @property
    def standard_error(self) -> StandardError:
        """Jackknife covariance (M - 1) / M sum_m (beta_m - beta)(beta_m - beta)'."""
        moved = np.sqrt(self._freedom / len(self.betas)) * (self.betas - self.beta)
        return StandardError(moved.T @ moved, self._freedom)

    def torque_margins(self, level: float = LEVEL) -> Array:
        """Return half of the length (rows,) of the prediction interval for the torque of another
        motion: Student's quantile times the RMS error on motions left out, which holds noise,
        misfit and the uncertainty of the parameters."""
        rms = np.sqrt((self.errors**2).mean(axis=0))
        return np.asarray(coverage_factor(level, self._freedom) * rms)


def motion_fit(problem: Problem, estimate: Estimate) -> MotionFit | str:
    """Return the fits without each motion, with the weights of the estimate of all of them; or the
    reason why there are none.

    R factors of the single motions make them: no sample is read again.
    """
    if estimate.beta is None or estimate.sigma is None:
        return "only for weighted least squares on rows, whose weights each motion can keep"
    if len(problem.motions) < ENOUGH_MOTIONS:
        count = max(len(problem.motions), 1)
        return f"{count} training motion{'s' if count > 1 else ''}; {ENOUGH_MOTIONS} are needed"
    weights = (1 / estimate.sigma).tolist()
    factors = [stacked_factor(motion, weights) for motion in problem.motions]
    betas, errors = [], []
    for index, motion in enumerate(problem.motions):
        R = qr_factor(factor for i, factor in enumerate(factors) if i != index)
        if not _is_excited(R):
            return f"motion {index + 1} alone excites some parameter"
        betas.append(solve_factor(R))
        errors.append(residual_norm(motion, betas[-1]) / np.sqrt(_counts(motion)))
    return MotionFit(estimate.beta, np.array(betas), np.array(errors))


def _is_excited(R: Array) -> bool:
    r = R.shape[1] - 1
    return bool(data_rank(R[:r, :r]) == r)


def _counts(problem: Problem) -> Array:
    """Samples (rows,) of each row, at least one."""
    return np.array([max(factor.samples, 1) for factor in problem.factors])
