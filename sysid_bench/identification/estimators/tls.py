"""Total least squares: errors in the regressor as well as in the torque."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.normal_qr import require_excited, stacked_factor
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class TLS:
    """beta = (W'W - s^2 1)^-1 W'b on unit columns, s the smallest singular value of [W b].

    Assumes independent errors of equal size in all columns of W and in b, each relative to its
    RMS: so the answer does not depend on units, but on which base parameters are taken. Encoder
    noise makes dependent errors of different size: TLS is then biased. Covariance (1 + |beta|^2)
    s^2 / M (W'W - s^2 1)^-1, first order in the noise. Golub and Van Loan (1980); Van Huffel and
    Vandewalle (1991), section 8.3; Gautier, Vandanjon, Presse (1994).
    """

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction or
        the errors are too large for W to tell beta."""
        R = stacked_factor(problem)
        require_excited(R)
        norms = np.linalg.norm(R, axis=0)
        if norms[-1] == 0.0:
            return Estimate(np.zeros(problem.base.rank))
        unit = R / norms
        smallest = np.linalg.svd(unit, compute_uv=False)[-1]
        U, values, Vt = np.linalg.svd(unit[:, :-1], full_matrices=False)
        room = values**2 - smallest**2
        if room[-1] <= 1e-3 * values[-1] ** 2:
            raise EstimationError(
                "Errors in the regressor are as large as its least excited direction: total least "
                "squares has no answer; filter the signals, or record a richer motion."
            )
        scale = norms[-1] / norms[:-1]
        beta = Vt.T @ (values / room * (U.T @ unit[:, -1]))
        spread = Vt.T / np.sqrt(room) * smallest * np.sqrt((1 + beta @ beta) / self._rows(problem))
        spread = scale[:, None] * spread
        stats = {"smallest_singular_value": float(smallest)}
        return Estimate(scale * beta, covariance=spread @ spread.T, stats=stats)

    def _rows(self, problem: Problem) -> int:
        return max(sum(f.samples for f in problem.factors if len(f.columns)), 1)
