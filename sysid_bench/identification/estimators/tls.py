"""Total least squares: errors in the regressor and in the torque."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.least_squares import check_rank, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class TLS:
    """beta = (W'W - s^2 1)^-1 W'b on unit columns, s the smallest singular value of [W b].

    Assumes independent errors of equal size, relative to the RMS, in all columns of W and in b: the
    result does not depend on units, but on the choice of base parameters. Encoder noise gives
    dependent errors of unequal size, and TLS is then biased. Closed form, no settings. Covariance
    (1 + |beta|^2) s^2 / M (W'W - s^2 1)^-1 to first order. Golub and Van Loan (1980); Van Huffel
    and Vandewalle (1991), section 8.3; Gautier, Vandanjon, Presse (1994).
    """

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction or the errors exceed the least excited direction."""
        R = stacked_factor(problem)
        check_rank(R)
        norms = np.linalg.norm(R, axis=0)
        if norms[-1] == 0.0:
            return Estimate(np.zeros(problem.base.rank))
        unit = R / norms
        smallest = np.linalg.svd(unit, compute_uv=False)[-1]
        U, values, Vt = np.linalg.svd(unit[:, :-1], full_matrices=False)
        reduced = values**2 - smallest**2
        if reduced[-1] <= 1e-3 * values[-1] ** 2:
            raise EstimationError(
                "Errors in the regressor are as large as its least excited direction: total least "
                "squares has no solution; filter the signals, or record a richer motion."
            )
        scale = norms[-1] / norms[:-1]
        # (W'W - s^2 1)^-1 W'b: noise of variance s^2 has increased every squared singular value.
        beta = Vt.T @ (values / reduced * (U.T @ unit[:, -1]))
        root = Vt.T / np.sqrt(reduced) * smallest * np.sqrt((1 + beta @ beta) / self._rows(problem))
        root = scale[:, None] * root
        stats = {"smallest_singular_value": float(smallest)}
        return Estimate(scale * beta, covariance=root @ root.T, stats=stats)

    def _rows(self, problem: Problem) -> int:
        return max(sum(f.samples for f in problem.factors if len(f.columns)), 1)
