"""How sure an estimate is: covariances that hold where noise is not white.

The textbook covariance of weighted least squares takes every sample for new. Slow noise and errors
in q make neighbours alike, and its intervals too short; the two here let the data say how alike.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import stdtrit

from sysid_bench.errors import UsageError
from sysid_bench.identification.linear.normal_qr import stacked_factor
from sysid_bench.types import Array, Estimate, Problem

LEVEL: Final = 0.95
LEAST_PERIODS: Final = 2
"""A spread needs two."""

ENOUGH_PERIODS: Final = 5
"""From here on the spread over periods is the one that is told: with fewer, the deviation itself is
unsure by more than a third, and its interval wider than half as much again."""


@dataclass(frozen=True, eq=False)
class StandardError:
    """A covariance (r, r) and the degrees of freedom that it was estimated with."""

    covariance: Array
    freedom: float = np.inf

    @property
    def std(self) -> Array:
        """Standard deviations (r,)."""
        return np.sqrt(np.diag(self.covariance))

    def interval(self, beta: Array, level: float = LEVEL) -> tuple[Array, Array]:
        """(low, high), each (r,), by Student's distribution."""
        reach = quantile(level, self.freedom) * self.std
        return beta - reach, beta + reach


def quantile(level: float, freedom: float) -> float:
    """Half the width of the interval of a level, in standard deviations."""
    return float(stdtrit(min(freedom, 1e9), 0.5 + 0.5 * level))


def standard_errors(problem: Problem, estimate: Estimate) -> dict[str, StandardError]:
    """How sure an estimate is, in each way that its problem and method allow; the first is the one
    to be told: "periods" where the recording holds ENOUGH_PERIODS, then "residuals" (both for least
    squares on rows with weights), then "textbook", the method's own formula."""
    found = {}
    if estimate.beta is not None and estimate.sigma is not None:
        inverse, scores = _scores(problem, estimate.beta, estimate.sigma)
        if problem.period > 0 and problem.samples // problem.period >= ENOUGH_PERIODS:
            found["periods"] = _over_periods(inverse, scores, problem.period)
        found["residuals"] = _over_lags(inverse, scores, bandwidth(scores))
    if estimate.covariance is not None:
        found["textbook"] = StandardError(estimate.covariance)
    return found


def period_standard_error(
    problem: Problem, beta: Array, sigma: Array, samples: int
) -> StandardError:
    """From the spread over repeated periods of `samples` samples each, of a fit `beta` (r,) with
    rows divided by `sigma` (rows,).

    H^-1 (M / (M - 1) sum_m g_m g_m') H^-1 with g_m the sum of W' S^-1 r over period m of M: what
    each period alone would have moved the fit by. It assumes nothing of the noise but that periods
    are alike and independent, and covers errors in q too, though not their bias. Samples after
    the last full period are left out of the spread. Raises UsageError where fewer than two fit.
    """
    periods = problem.samples // samples if samples > 0 else 0
    if periods < LEAST_PERIODS:
        raise UsageError(
            f"{problem.samples} samples hold {periods} full periods of {samples}; two at least are "
            "needed to see a spread. Record more cycles, or take the sandwich."
        )
    return _over_periods(*_scores(problem, beta, sigma), samples)


def _over_periods(inverse: Array, scores: Array, samples: int) -> StandardError:
    periods = len(scores) // samples
    sums = scores[: periods * samples].reshape(periods, samples, -1).sum(axis=1)
    sums = sums - sums.mean(axis=0)
    # Full periods alone carry the spread; the fit rests on all samples.
    share = len(scores) / (periods * samples)
    parts = np.sqrt(share * periods / (periods - 1)) * sums @ inverse.T
    return StandardError(parts.T @ parts, periods - 1)


def residual_standard_error(
    problem: Problem, beta: Array, sigma: Array, lags: int | None = None
) -> StandardError:
    """With neighbours as alike as the residuals show: H^-1 S H^-1, S the long-run covariance of
    W' S^-1 r with Bartlett weights (Newey and West 1987).

    `lags`: samples that are told to be alike; None takes Andrews' (1991) rule for the slowest of
    the scores. Samples are in the order of time, and W is exact.
    """
    inverse, scores = _scores(problem, beta, sigma)
    return _over_lags(inverse, scores, bandwidth(scores) if lags is None else lags)


def _over_lags(inverse: Array, scores: Array, lags: int) -> StandardError:
    """Bartlett's weights are those of sums over all windows of `lags` + 1 samples, squared."""
    lags = min(lags, len(scores) - 1)
    total = np.cumsum(np.pad(scores, ((lags + 1, lags), (0, 0))), axis=0)
    windows = (total[lags + 1 :] - total[: -lags - 1]) @ inverse.T / np.sqrt(lags + 1)
    return StandardError(windows.T @ windows)


def bandwidth(scores: Array) -> int:
    """Andrews' rule for Bartlett weights: 1.1447 (a N)^(1/3) of the autoregressions of scores
    (N, r), the largest; at most a quarter of the samples."""
    count = len(scores)
    past, now = scores[:-1], scores[1:]
    squares = np.maximum((past**2).sum(axis=0), 1e-300)
    rho = np.clip((past * now).sum(axis=0) / squares, -0.99, 0.99)
    slowest = float((4 * rho**2 / ((1 - rho) ** 2 * (1 + rho) ** 2)).max(initial=0.0))
    return int(min(np.ceil(1.1447 * (slowest * count) ** (1 / 3)), count // 4))


def _scores(problem: Problem, beta: Array, sigma: Array) -> tuple[Array, Array]:
    """R^-1 (r, r) of the weighted rows, and the scores (N, r) in its coordinates: H^-1 W' S^-1 r is
    R^-1 times their sum."""
    R = stacked_factor(problem, (1 / sigma).tolist())[:-1, :-1]
    inverse = solve_triangular(R, np.eye(len(R)))
    forces = [np.einsum("nir,ni->nr", Y, (b - Y @ beta) / sigma**2) for Y, b in problem.blocks()]
    return inverse, np.concatenate(forces) @ inverse
