"""UKF: joint estimation of states and parameters with the unscented transform."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.errors import EstimationError
from sysid_bench.identification.simulation_based.joint_filter import (
    FilterEstimate,
    JointFilter,
    joint_filter,
)
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class UKF:
    """Unscented Kalman filter on the state [q v beta] (van der Merwe 2004).

    As `ekf`, with 2 k + 1 sigma points instead of derivatives; `spread` is their distance from the
    mean in standard deviations: 1 keeps them where the model is accurate. On recordings it starts
    from feasible least squares with a tenth of the torque as its error, torque noise is as strong
    as the residual of least squares at low frequencies, and friction follows the measured rate
    (measured_motion.py). Biased: torques between samples are interpolated linearly (`substeps`
    steps of Heun's rule per sample). One pass, no stop rule. Assumes white noise on q and tau.
    """

    spread: float = 1.0
    bias: ClassVar[str] = "torques between samples are interpolated linearly"
    substeps: int = 1

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the estimate after the last sample; raises EstimationError where the filter
        diverges, UnsupportedError for joints without scalar positions."""
        model = joint_filter(experiment, "The UKF", self.substeps)
        start = belief = model.measured(model.start(), 0)
        for k in range(len(model.q) - 1):
            belief = model.measured(self._predicted(model, belief, k), k + 1)
        return model.result(belief, start)

    def _predicted(self, model: JointFilter, belief: FilterEstimate, k: int) -> FilterEstimate:
        root = self.spread * _root(belief.covariance).T
        points = model.step(
            belief.mean + np.concatenate([root * 0, root, -root])[len(root) - 1 :], k
        )
        centre, plus, minus = points[0], points[1 : len(root) + 1], points[len(root) + 1 :]
        weight = 0.5 / self.spread**2
        mean = centre + weight * (plus + minus - 2 * centre).sum(axis=0)
        # Odd and even part of the model along each axis: slope and curvature.
        first = (plus - minus) / (2 * self.spread)
        bend = (plus + minus - 2 * centre) / (2 * self.spread**2)
        P = first.T @ first + 0.5 * bend.T @ bend + model.process_noise(belief.mean)
        return FilterEstimate(mean, 0.5 * (P + P.T))


def _root(P: Array) -> Array:
    """Cholesky factor L (k, k) of P, with a small multiple of the diagonal added where rounding
    has made P indefinite."""
    scale = np.sqrt(np.diag(P))
    scale = np.where(scale > 0, scale, 1.0)
    even = P / np.outer(scale, scale)
    for share in (0.0, 1e-13, 1e-11, 1e-9, 1e-7):
        try:
            return scale[:, None] * np.linalg.cholesky(even + share * np.eye(len(P)))
        except np.linalg.LinAlgError:
            continue
    raise EstimationError(
        "The filter's covariance is not positive definite: the noise is too large."
    )
