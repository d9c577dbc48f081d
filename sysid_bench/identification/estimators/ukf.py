"""UKF: joint estimation of states and parameters with the scaled unscented transform."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.simulation_based.joint_filter import (
    FilterEstimate,
    JointFilter,
    joint_filter,
)
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class UKF:
    """Unscented Kalman filter on the state [q v beta] with the scaled unscented transform.

    As `ekf`, with the transform of van der Merwe (2004, section 3.2.2; Julier 2002) instead of
    derivatives: 2 L + 1 sigma points at the mean and at plus and minus sqrt(L + lambda) columns of
    a root of the covariance, lambda = alpha^2 (L + kappa) - L, with the weights lambda / (L +
    lambda) of the centre and 1 / (2 (L + lambda)) of the others; in the covariance the centre has
    1 - alpha^2 + beta more. Torque noise is additive, so that the state is not augmented by it.

    The defaults are those of van der Merwe: beta = 2 is optimal for Gaussian states, kappa = 0, and
    alpha = 1e-3 keeps the points near the mean. With alpha = 1 they lie sqrt(L) deviations away,
    for an arm at parameters that no physical body has. On recordings it starts from feasible least
    squares with a tenth of the torque as its error, torque noise is as strong as the residual of
    least squares at low frequencies, and friction follows the measured rate (measured_motion.py).
    Biased: torques between samples are interpolated linearly (`substeps` steps of Heun's rule per
    sample). One pass, no stop rule. Assumes white noise on q and tau.
    """

    alpha: float = 1e-3
    beta: float = 2.0
    kappa: float = 0.0
    bias: ClassVar[str] = "torques between samples are interpolated linearly"
    substeps: int = 1

    def __post_init__(self) -> None:
        """Raise UsageError unless alpha is positive."""
        if not self.alpha > 0:
            raise UsageError(f"alpha = {self.alpha}: give a positive number.")

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the estimate after the last sample; raises EstimationError where the filter
        diverges, UnsupportedError for joints without scalar positions."""
        model = joint_filter(experiment, "The UKF", self.substeps)
        start = belief = model.measured(model.start(), 0)
        for k in range(len(model.q) - 1):
            belief = model.measured(self._predicted(model, belief, k), k + 1)
        return model.result(belief, start)

    def _predicted(self, model: JointFilter, belief: FilterEstimate, k: int) -> FilterEstimate:
        mean, P = self.transform(
            lambda points: model.step(points, k), belief.mean, belief.covariance
        )
        P = P + model.process_noise(belief.mean)
        return FilterEstimate(mean, 0.5 * (P + P.T))

    def transform(
        self, function: Callable[[Array], Array], mean: Array, covariance: Array
    ) -> tuple[Array, Array]:
        """Mean (m,) and covariance (m, m) of function(x) for x of a mean (k,) and a covariance
        (k, k); the function takes points (S, k) and gives (S, m)."""
        L = len(mean)
        spread = self.alpha**2 * (L + self.kappa)  # L + lambda
        if spread <= 0:
            raise UsageError(f"kappa = {self.kappa}: give a number above {-L}, minus the states.")
        root = np.sqrt(spread) * _root(covariance).T
        points = function(mean + np.concatenate([np.zeros((1, L)), root, -root]))
        weights = np.full(2 * L + 1, 0.5 / spread)
        weights[0] = 1 - L / spread
        # About the centre: the weights sum to one, and large ones cancel exactly.
        away = points - points[0]
        shift = weights @ away
        away = away - shift
        weights[0] += 1 - self.alpha**2 + self.beta
        return points[0] + shift, (away.T * weights) @ away


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
