"""Tukey's M-estimate: far residuals do not count at all."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.identification.estimators.huber import Huber, huber_loss
from sysid_bench.identification.linear.m_estimation import Loss, m_estimate, m_estimate_result
from sysid_bench.identification.linear.weights import weighted_fit
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class Tukey:
    """Rows weighted (1 - (r / s / cut)^2)^2 within `cut`, 0 beyond, from Huber's estimate and with
    its scales s: the loss is not convex, so that where it ends depends on where it starts.

    Beaton and Tukey (1974); Holland and Welsch (1977). With cut = 4.685 it has 95 % of the
    efficiency of least squares under Gaussian noise. Assumes W exact; outliers in torque alone.
    """

    cut: float = 4.685
    iterations: int = 200

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction or
        the weights do not come to rest."""
        start, _, _ = weighted_fit(problem)
        first = m_estimate(problem, huber_loss(Huber.cut), start, self.iterations)
        loss = tukey_loss(self.cut)
        fit = m_estimate(problem, loss, first.beta, self.iterations, first.scales)
        return m_estimate_result(problem, loss, fit)


def tukey_loss(cut: float) -> Loss:
    """psi(u) = u (1 - (u / cut)^2)^2 inside of `cut`, zero outside."""

    def inside(u: Array) -> Array:
        return np.maximum(1.0 - (u / cut) ** 2, 0.0)

    return Loss(
        lambda u: inside(u) ** 2,
        lambda u: inside(u) * (1.0 - 5.0 * (u / cut) ** 2),
    )
