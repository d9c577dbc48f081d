"""Covariance of a least-squares estimate under coloured noise.

The textbook covariance assumes independent samples. Low-frequency noise and errors in q correlate
neighbouring samples, which makes its intervals too short. Two robust covariances are offered here:
from the scatter over repeated periods, and from the autocorrelation of the residuals (HAC). Neither
knows of misfit, which repeats itself; the spread between motions does (motion_spread.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.motion_spread import MotionFit, motion_fit
from sysid_bench.evaluation.standard_error import StandardError
from sysid_bench.identification.linear.least_squares import stacked_factor
from sysid_bench.types import Array, Estimate, Problem

LEAST_PERIODS: Final = 2
"""Minimal number of periods for a covariance."""

ENOUGH_PERIODS: Final = 5
"""Minimal number of periods for reporting their covariance: with fewer, the standard deviation is
itself uncertain by more than a third, and Student's interval more than 1.5 times wider."""


@dataclass(frozen=True, eq=False)
class ResidualScore:
    """Scores g_k = W_k' S^-1 r_k of weighted least squares, one for each sample k.

    The covariance of beta is H^-1 L H^-1 with H = W' S^-1 W = R'R and L the covariance of their
    sum; both methods below estimate L. `values` (N, r) are R^-T g_k and `inverse` (r, r) is R^-1,
    so that `inverse` times their sum is H^-1 W' S^-1 r without squaring the condition of W.
    """

    inverse: Array
    values: Array

    def period_covariance(
        self, samples: int, motions: Sequence[tuple[int, int]] = ()
    ) -> StandardError:
        """Return the cluster-robust covariance over repeated periods of `samples` samples each.

        L = M / (M - 1) sum_m (g_m - mean)(g_m - mean)', g_m the sum over period m of M. Periods are
        assumed independent and identically distributed. Errors in q are covered, but not the bias
        that they cause. An incomplete last period is left out. `motions` are the samples of each
        of several motions and of its period: L is then the sum over motions, each about its own
        mean. Raises UsageError for fewer than two periods of a motion.
        """
        counts, periods = zip(*motions or ((len(self.values), samples),), strict=True)
        split = np.split(self.values, np.cumsum(counts)[:-1])
        parts = [self._period_parts(*one) for one in zip(split, periods, strict=True)]
        scatter = np.concatenate(parts)
        return StandardError(scatter.T @ scatter, len(scatter) - len(parts))

    def _period_parts(self, values: Array, samples: int) -> Array:
        """Parts (M, r) of the error from each period of one motion, about their mean."""
        periods = len(values) // samples if samples > 0 else 0
        if periods < LEAST_PERIODS:
            raise UsageError(
                f"{len(values)} samples contain {periods} full periods of {samples}; a "
                "covariance needs at least two. Record more periods, or use residual_covariance."
            )
        sums = values[: periods * samples].reshape(periods, samples, -1).sum(axis=1)
        sums = sums - sums.mean(axis=0)
        # Scores come from full periods alone, but the fit uses all samples.
        share = len(values) / (periods * samples)
        return np.asarray(np.sqrt(share * periods / (periods - 1)) * sums @ self.inverse.T)

    def residual_covariance(self, lags: int) -> StandardError:
        """Return the heteroskedasticity- and autocorrelation-consistent (HAC) covariance.

        L is the long-run covariance with Bartlett weights (Newey and West 1987) up to `lags`
        samples. Samples have to be in temporal order; W is taken as exact.
        """
        lags = min(lags, len(self.values) - 1)
        # The outer products of sums over all windows of `lags` + 1 samples give exactly Bartlett's
        # weights: a pair k samples apart is in lags + 1 - k windows.
        total = np.cumsum(np.pad(self.values, ((lags + 1, lags), (0, 0))), axis=0)
        windows = (total[lags + 1 :] - total[: -lags - 1]) @ self.inverse.T / np.sqrt(lags + 1)
        return StandardError(windows.T @ windows)

    @property
    def bandwidth(self) -> int:
        """Lags for Bartlett weights by Andrews' rule (1991): 1.1447 (a N)^(1/3), with a from a
        first-order autoregression of each score; the largest, at most N / 4."""
        count = len(self.values)
        previous, current = self.values[:-1], self.values[1:]
        squares = np.maximum((previous**2).sum(axis=0), 1e-300)
        # A fitted |rho| of one would mean a random walk, and no finite bandwidth.
        rho = np.clip((previous * current).sum(axis=0) / squares, -0.99, 0.99)
        slowest = float((4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)).max(initial=0.0))
        return int(min(np.ceil(1.1447 * (slowest * count) ** (1 / 3)), count // 4))


def residual_score(problem: Problem, beta: Array, sigma: Array) -> ResidualScore:
    """Return the scores of a fit `beta` (r,) with rows divided by `sigma` (rows,)."""
    R = stacked_factor(problem, (1 / sigma).tolist())[:-1, :-1]
    inverse = solve_triangular(R, np.eye(len(R)))
    # The residual enters with 1 / sigma^2: once by the weighted row, once by the weighted residual.
    forces = [np.einsum("nir,ni->nr", Y, (b - Y @ beta) / sigma**2) for Y, b in problem.blocks()]
    return ResidualScore(inverse, np.concatenate(forces) @ inverse)


def standard_errors(problem: Problem, estimate: Estimate) -> dict[str, StandardError]:
    """Return the covariances of an estimate by kind; the first one is to be reported.

    "motions" if there are ENOUGH_MOTIONS, "periods" if the recording has ENOUGH_PERIODS, then
    "residuals" (all three for weighted least squares on rows), then "textbook", the formula of the
    method itself.
    """
    found: dict[str, StandardError] = {}
    fits = motion_fit(problem, estimate)
    if isinstance(fits, MotionFit):
        found["motions"] = fits.standard_error
    if estimate.beta is not None and estimate.sigma is not None:
        found |= _robust(problem, residual_score(problem, estimate.beta, estimate.sigma))
    if estimate.covariance is not None:
        found["textbook"] = StandardError(estimate.covariance)
    return found


def _robust(problem: Problem, scores: ResidualScore) -> dict[str, StandardError]:
    """The covariances that hold under coloured noise, that over periods first."""
    found = {}
    if _has_periods(problem):
        motions = [(motion.samples, motion.period) for motion in problem.motions]
        found["periods"] = scores.period_covariance(problem.period, motions)
    return found | {"residuals": scores.residual_covariance(scores.bandwidth)}


def _has_periods(problem: Problem) -> bool:
    """True where there are enough periods, and two or more of each motion."""
    motions = problem.motions or (problem,)
    if any(one.period == 0 for one in motions):
        return False
    counts = [one.samples // one.period for one in motions]
    return sum(counts) >= ENOUGH_PERIODS and min(counts) >= LEAST_PERIODS
