"""EKF: joint estimation of states and parameters with linearised dynamics."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.simulation_based.forward_model import finite_difference
from sysid_bench.identification.simulation_based.joint_filter import (
    FilterEstimate,
    JointFilter,
    joint_filter,
)
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class EKF:
    """Extended Kalman filter on the state [q v beta] (Gautier and Poignet 2001).

    beta is constant, measured torques are inputs, measured positions are outputs. Noise levels come
    from high-order differences of the signals; starts from the prior and its standard deviations,
    else from least squares. Biased: torques between samples are interpolated linearly (`substeps`
    steps of Heun's rule per sample), and errors of the linearisation are not part of the
    covariance. One pass, no stop rule. Assumes white noise on q and tau.
    """

    bias: ClassVar[str] = "torques between samples are interpolated linearly"
    substeps: int = 1

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the estimate after the last sample; raises EstimationError where the filter
        diverges, UnsupportedError for joints without scalar positions."""
        model = joint_filter(experiment, "The EKF", self.substeps)
        start = belief = model.measured(model.start(), 0)
        for k in range(len(model.q) - 1):
            belief = model.measured(_predicted(model, belief, k), k + 1)
        return model.result(belief, start)


def _predicted(model: JointFilter, belief: FilterEstimate, k: int) -> FilterEstimate:
    sizes = _sizes(belief)
    F = finite_difference(lambda states: model.step(states, k), belief.mean, sizes)
    mean = model.step(belief.mean[None], k)[0]
    # Process noise of beta is zero: a constant only becomes more certain.
    P = F @ belief.covariance @ F.T + model.process_noise(belief.mean)
    return FilterEstimate(mean, 0.5 * (P + P.T))


def _sizes(belief: FilterEstimate) -> Array:
    """Finite-difference steps (k,): a hundredth of the standard deviations, above rounding."""
    return np.asarray(
        np.maximum(1e-2 * np.sqrt(np.diag(belief.covariance)), 1e-7 * np.abs(belief.mean) + 1e-9)
    )
