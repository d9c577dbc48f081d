"""EKF: joint estimation of states and parameters with linearised dynamics."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.identification.simulation_based.joint_filter import (
    FilterEstimate,
    JointFilter,
    joint_filter,
)
from sysid_bench.identification.simulation_based.sensitivity import (
    SensitivityModel,
    start_state,
)
from sysid_bench.types import Estimate, Experiment


@dataclass(frozen=True)
class EKF:
    """Extended Kalman filter on the state [q v beta] (Gautier and Poignet 2001).

    beta is constant, measured torques are inputs, measured positions are outputs. Noise levels come
    from high-order differences of the signals; starts from the prior and its standard deviations,
    else from least squares. On recordings it starts from feasible least squares with a tenth of the
    torque as its error, torque noise is as strong as the residual of least squares at low
    frequencies, and friction follows the measured rate (measured_motion.py). Biased: torques
    between samples are interpolated linearly (`substeps` steps of Heun's rule per sample), and
    errors of the linearisation are not part of the covariance. One pass, no stop rule. Assumes
    white noise on q and tau.
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
    n, mean = model.n, belief.mean
    sensitive = SensitivityModel(model.forward, model.measured_motion, mean[2 * n :])
    start = start_state(mean[None, :n], mean[None, n : 2 * n], len(mean) - 2 * n)
    x = sensitive.step(start, np.array([k]))
    # Process noise of beta is zero: a constant only becomes more certain.
    F = np.eye(len(mean))
    F[: 2 * n] = np.concatenate([x.dq[0], x.dv[0]])
    assert x.M is not None
    P = F @ belief.covariance @ F.T + model.process_noise_of(x.M[0], len(mean))
    return FilterEstimate(np.concatenate([x.q[0], x.v[0], mean[2 * n :]]), 0.5 * (P + P.T))
