"""Kalman filter of drifting parameters: a random walk measured by torques."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identification.feasibility.feasible_prior import find_prior
from sysid_bench.identification.linear.least_squares import (
    check_rank,
    inverse_of,
    row_noise,
    solve_factor,
    stacked_factor,
)
from sysid_bench.identification.linear.recursive_qr import rank_update
from sysid_bench.qr_factor import qr_factor
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class Kalman:
    """beta_(k+1) = beta_k + w_k, b_k = W_k beta_k + v_k; returns beta after the last sample.

    v has the noise of each joint (as `wls`). `drift`: standard deviation of the walk over the whole
    recording relative to that of the prior, parameter by parameter; the default 0 gives `wls`,
    since the start is diffuse. Square-root information filter (Bierman 1977, chapter 5); the walk
    takes a step every `hold` samples (20: parameters drift slowly against the sampling). Assumes W
    exact, white noise. Gautier and Poignet (2001).
    """

    drift: float = 0.0
    hold: int = 20

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction, or where a drift has no prior to scale it; UsageError for invalid settings.
        """
        if self.drift < 0 or self.hold < 1:
            raise UsageError(f"{self} is invalid: drift must be 0 or more, hold at least 1.")
        check_rank(stacked_factor(problem))
        sigma, r = row_noise(problem), problem.base.rank
        walk = self._walk(problem) if self.drift > 0 else None
        R = np.zeros((r + 1, r + 1))
        for Y, b in problem.blocks():
            for start in range(0, len(b), self.hold):
                part = slice(start, start + self.hold)
                R = rank_update(R if walk is None else _walked(R, walk), Y[part], b[part], sigma)
        inverse = inverse_of(R)
        return Estimate(solve_factor(R), covariance=inverse @ inverse.T)

    def _walk(self, problem: Problem) -> Array:
        """Square root S (r, r) of the covariance S S' of one step of the walk."""
        steps = max(problem.samples / self.hold, 1.0)
        spread = problem.base.K * find_prior(problem).std
        return np.asarray(np.asarray(qr_factor([spread.T]).T) * self.drift / np.sqrt(steps))


def _walked(R: Array, walk: Array) -> Array:
    """[R | z] after one step beta + S u of the walk: u is eliminated from the rows [1, 0; -R S, R]
    of (u, beta + S u) by QR."""
    r = len(walk)
    known = np.vstack(
        [np.hstack([np.eye(r), np.zeros((r, r + 1))]), np.hstack([-R[:, :r] @ walk, R])]
    )
    return qr_factor([known])[r:, r:]
