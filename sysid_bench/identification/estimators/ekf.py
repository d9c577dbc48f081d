"""EKF: states and parameters together, the model linearised at every sample."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.simulation_based.filters import (
    FilterState,
    JointFilter,
    joint_filter,
)
from sysid_bench.identification.simulation_based.forward_dynamics import differences
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class EKF:
    """Extended Kalman filter on [q v beta], beta constant, driven by the measured torques and
    corrected by the measured positions (Gautier, Poignet 2001).

    Noise levels are read off the signals. Starts from the prior and its spread, else from least
    squares. Not consistent: torques between samples are taken as straight lines, and the
    linearisation forgets what it has not seen; `substeps` of Heun's rule per sample.
    """

    bias: ClassVar[str] = "torques between samples are taken as straight lines"
    substeps: int = 1

    def fit(self, experiment: Experiment) -> Estimate:
        """The estimate after the last sample; raises EstimationError where it runs away."""
        model = joint_filter(experiment, "The EKF", self.substeps)
        start = belief = model.measured(model.start(), 0)
        for k in range(len(model.q) - 1):
            belief = model.measured(_predicted(model, belief, k), k + 1)
        return model.result(belief, start)


def _predicted(model: JointFilter, belief: FilterState, k: int) -> FilterState:
    sizes = _sizes(belief)
    F = differences(lambda states: model.step(states, k), belief.mean, sizes)
    mean = model.step(belief.mean[None], k)[0]
    P = F @ belief.covariance @ F.T + model.process_noise(belief.mean)
    return FilterState(mean, 0.5 * (P + P.T))


def _sizes(belief: FilterState) -> Array:
    """Steps (k,) of the differences: a hundredth of what is uncertain, above rounding."""
    return np.maximum(1e-2 * np.sqrt(np.diag(belief.covariance)), 1e-7 * np.abs(belief.mean) + 1e-9)
