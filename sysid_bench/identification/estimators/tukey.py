"""Tukey's M-estimator: residuals beyond a threshold do not count."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.identification.estimators.huber import Huber, huber_loss
from sysid_bench.identification.linear.reweighted_rows import (
    Loss,
    m_estimate,
    m_estimate_result,
    scaled_rows,
)
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class Tukey:
    """M-estimate with the weights (1 - (r / s / cut)^2)^2 for |r / s| <= cut, zero beyond.

    Iteratively reweighted least squares from Huber's estimate, whose scales s it holds: the loss is
    not convex, so that the start decides between local minima. Stops where a step changes the
    torques by less than 1e-10 of them. cut = 4.685 has 95 % of the efficiency of least squares
    under Gaussian noise. Assumes W exact; outliers in the torques alone. Beaton and Tukey (1974);
    Holland, Welsch (1977).
    """

    cut: float = 4.685
    iterations: int = 200

    def solve(self, problem: Problem) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the motion does not excite
        every direction."""
        rows, start = scaled_rows(problem)
        first = m_estimate(rows, huber_loss(Huber.cut), start, self.iterations)
        loss = tukey_loss(self.cut)
        fit = m_estimate(rows, loss, first.beta, self.iterations, first.scales)
        return m_estimate_result(problem, loss, fit)


def tukey_loss(cut: float) -> Loss:
    """Return psi(u) = u (1 - (u / cut)^2)^2 for |u| <= cut, zero beyond."""

    def inside(u: Array) -> Array:
        return np.maximum(1.0 - (u / cut) ** 2, 0.0)

    return Loss(
        lambda u: inside(u) ** 2,
        lambda u: inside(u) * (1.0 - 5.0 * (u / cut) ** 2),
    )
