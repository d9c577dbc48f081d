"""Ridge regression: least squares drawn towards zero where the data say little."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identification.linear.normal_qr import require_excited, stacked_factor
from sysid_bench.identification.linear.weights import row_sigmas
from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class Ridge:
    """min |W beta - b|^2 + k |beta|^2 on unit columns of rows divided by their noise (as `wls`), so
    that kg and kg m^2 are not mixed.

    `weight` is k; None takes r / |beta|^2 of weighted least squares (Hoerl, Kennard, Baldwin 1975),
    which fades where the data are exact. With a weight it answers for motions too that do not
    excite every direction. Covariance without the bias: its variance alone. Hoerl and Kennard
    (1970). Assumes W exact and white noise per joint.
    """

    weight: float | None = None
    bias: ClassVar[str] = (
        "drawn towards zero by the weight; none where data are exact and no weight is set"
    )

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; without a weight raises EstimationError where the motion does not excite
        every direction."""
        if self.weight is not None and not self.weight > 0:
            raise UsageError(
                f"The ridge's weight is {self.weight}; it has to be positive, or none."
            )
        R = stacked_factor(problem, (1.0 / row_sigmas(problem)).tolist())
        norms = np.linalg.norm(R[:, :-1], axis=0)
        norms = np.where(norms > 0, norms, 1.0)
        U, values, Vt = np.linalg.svd(R[:, :-1] / norms, full_matrices=False)
        told = U.T @ R[:, -1]
        weight = self.weight
        if weight is None:
            require_excited(stacked_factor(problem))
            weight = problem.base.rank / max(float(np.sum((told / values) ** 2)), 1e-300)
        gains = values / (values**2 + weight)
        spread = Vt.T * gains / norms[:, None]
        beta = Vt.T @ (gains * told) / norms
        return Estimate(beta, covariance=spread @ spread.T, stats={"weight": float(weight)})
