"""Covariances of an estimate, in the order in which they are reported.

- Spread between motions: a model error repeats itself in every period of a motion, and acts
  otherwise in another motion. The jackknife over motions (cluster-robust covariance CV3; MacKinnon,
  Nielsen and Webb 2023) therefore contains both noise and misfit. It does not contain what all
  motions share: the bias of a gain, of a filter, of friction that the model lacks.
- Scatter over repeated periods, and autocorrelation of the residuals (HAC): the textbook covariance
  assumes independent samples. Low-frequency noise and errors in q correlate neighbouring samples,
  which makes its intervals too short. Neither knows of misfit, which repeats itself.
- Spread over blocks of time, for methods that give no covariance of their own: feasible and
  regularised fits are not linear in the data, no formula of least squares is theirs. The
  delete-a-group jackknife (Tukey 1958; Busing, Meijer, van der Leeden 1999) repeats the fit with
  each block of time left out, constraints and prior included. A parameter that a constraint holds
  in every fit does not move: its spread of zero is no deviation, and it has none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.evaluation.intervals import StandardError, coverage_factor, jackknife
from sysid_bench.evaluation.score import base_parameters
from sysid_bench.identification.identify import identify
from sysid_bench.identification.linear.cross_validation import time_blocks
from sysid_bench.identification.linear.least_squares import (
    data_rank,
    inverse_of,
    residual_norm,
    solve_factor,
    stacked_factor,
)
from sysid_bench.numerics import qr_factor
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
    def standard_error(self) -> StandardError:
        """Jackknife covariance (M - 1) / M sum_m (beta_m - beta)(beta_m - beta)'."""
        return jackknife(self.betas, self.beta)

    def torque_margins(self) -> Array:
        """Return half of the length (rows,) of the prediction interval for the torque of another
        motion: Student's quantile times the RMS error on motions left out, which holds noise,
        misfit and the uncertainty of the parameters."""
        rms = np.sqrt((self.errors**2).mean(axis=0))
        return np.asarray(coverage_factor(len(self.betas) - 1) * rms)


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
    # Weights of all motions: the spread is that of one estimator, not of as many as there are
    # parts.
    weights = (1 / estimate.sigma).tolist()
    factors = [stacked_factor(motion, weights) for motion in problem.motions]
    betas, errors = [], []
    for index, motion in enumerate(problem.motions):
        R = qr_factor(factor for i, factor in enumerate(factors) if i != index)
        r = R.shape[1] - 1
        if data_rank(R[:r, :r]) < r:
            return f"motion {index + 1} alone excites some parameter"
        betas.append(solve_factor(R))
        errors.append(
            residual_norm(motion, betas[-1])
            / np.sqrt(np.array([max(factor.samples, 1) for factor in motion.factors]))
        )
    return MotionFit(estimate.beta, np.array(betas), np.array(errors))


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
    inverse = inverse_of(stacked_factor(problem, (1 / sigma).tolist()))
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
        scores = residual_score(problem, estimate.beta, estimate.sigma)
        motions = problem.motions or (problem,)
        counts = [one.samples // one.period if one.period else 0 for one in motions]
        # Enough periods, and two or more of each motion.
        if sum(counts) >= ENOUGH_PERIODS and min(counts) >= LEAST_PERIODS:
            parts = [(one.samples, one.period) for one in problem.motions]
            found["periods"] = scores.period_covariance(problem.period, parts)
        found["residuals"] = scores.residual_covariance(scores.bandwidth)
    if estimate.covariance is not None:
        found["textbook"] = StandardError(estimate.covariance)
    return found


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
    spread = jackknife(np.array(betas), np.mean(betas, axis=0))
    still = spread.std <= HELD * np.abs(estimate.beta)
    free = np.where(still, np.nan, 1.0)
    return replace(spread, covariance=spread.covariance * np.outer(free, free))
