"""Essential parameters: base parameters without significant effect are set to zero."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.special import fdtri

from sysid_bench.identification.linear.least_squares import inverse_of, scaled_fit, solve_factor
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class Essential:
    """Weighted least squares with backward elimination of base parameters.

    Removes the base parameter of largest relative standard deviation, one at a time, until that is
    at most `ratio` times the smallest, or until an F-test at `level` rejects the removal. Removed
    parameters are zero with zero variance. ratio = 20 lies in the published range of 10 to 30,
    level 0.05 is the usual one. Assumes W exact and white noise per joint; the result depends on
    the choice of base parameters. Pham and Gautier (1991); Gautier and Khalil (1991).
    """

    ratio: float = 20.0
    level: float = 0.05

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        _, full, _ = scaled_fit(problem)
        r = problem.base.rank
        # Rows have unit noise: the residual sum of squares that a removal adds is chi-square.
        freedom = max(sum(f.samples for f in problem.factors if len(f.columns)) - r, 1)
        kept, R = np.arange(r), full
        while len(kept) > 1:
            worst, over = _least_certain(R)
            if over <= self.ratio:
                break
            fewer = np.delete(kept, worst)
            smaller = _without(full, fewer)
            # The last diagonal entry of R is the norm of the residual.
            added = (smaller[-1, -1] ** 2 - full[-1, -1] ** 2) / (r - len(fewer))
            if added > fdtri(r - len(fewer), freedom, 1.0 - self.level):
                break
            kept, R = fewer, smaller
        beta, covariance = np.zeros(r), np.zeros((r, r))
        beta[kept] = solve_factor(R)
        inverse = inverse_of(R)
        covariance[np.ix_(kept, kept)] = inverse @ inverse.T
        return Estimate(beta, covariance=covariance, stats={"essential": float(len(kept))})


def _least_certain(R: Array) -> tuple[int, float]:
    """Index of the largest relative standard deviation, and its ratio to the smallest."""
    relative = np.linalg.norm(inverse_of(R), axis=1) / np.maximum(np.abs(solve_factor(R)), 1e-300)
    worst = int(np.argmax(relative))
    return worst, float(relative[worst] / relative.min())


def _without(R: Array, kept: Array) -> Array:
    """QR factor (k + 1, k + 1) of the kept columns and the right-hand side."""
    return np.asarray(qr(R[:, [*kept, -1]], mode="r")[0][: len(kept) + 1])
