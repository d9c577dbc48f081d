"""Huber's M-estimate: large residuals count linearly."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.identification.linear.m_estimation import Loss, m_estimate, m_estimate_result
from sysid_bench.identification.linear.weights import weighted_fit
from sysid_bench.types import Array, Estimate, Problem


@dataclass(frozen=True)
class Huber:
    """Rows weighted min(1, cut / |r / s|), s the robust scale of each joint, until they rest.

    Huber (1964); Holland and Welsch (1977). With cut = 1.345 it has 95 % of the efficiency of
    least squares under Gaussian noise. Assumes W exact; outliers in torque alone.
    """

    cut: float = 1.345
    iterations: int = 200

    def solve(self, problem: Problem) -> Estimate:
        """The estimate; raises EstimationError where the motion does not excite every direction or
        the weights do not come to rest."""
        start, _, _ = weighted_fit(problem)
        loss = huber_loss(self.cut)
        return m_estimate_result(problem, loss, m_estimate(problem, loss, start, self.iterations))


def huber_loss(cut: float) -> Loss:
    """psi(u) = u inside of `cut`, its sign times `cut` outside."""

    def weight(u: Array) -> Array:
        return cut / np.maximum(np.abs(u), cut)

    return Loss(weight, lambda u: (np.abs(u) < cut).astype(float))
