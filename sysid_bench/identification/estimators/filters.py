"""Joint estimation of states and parameters by nonlinear Kalman filters: the state [q v beta]."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.linear.least_squares import dense_rows, solve, stacked_factor
from sysid_bench.identification.simulation_based.compiled_filters import (
    INDEFINITE,
    filters_library,
    run_filter,
)
from sysid_bench.identification.simulation_based.forward_model import (
    AccelerationModel,
    SensitivityModel,
    compiled_steps,
    scalar_joints,
    start_state,
)
from sysid_bench.identification.simulation_based.gauss_newton import (
    regressor_of,
    residual_factor,
    step_rms,
)
from sysid_bench.identification.simulation_based.measured_motion import (
    MeasuredMotion,
    feasible_start,
    measured_motion,
    white_noise,
)
from sysid_bench.numerics import correlation_time
from sysid_bench.types import Array, Estimate, Experiment

START_ERROR = 0.1
"""Torque error of the start without a prior, relative to the RMS torque."""

NOISE_FLOOR = (1e-5, 1e-2)
"""Least noise of positions and torques in a filter, relative to their RMS: discretisation errors
count as noise, or the filter diverges."""


@dataclass(frozen=True, eq=False)
class FilterEstimate:
    """Mean (k,) and covariance (k, k) of the state [q v beta]."""

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class JointFilter:
    """Model of a joint filter: measured motion, and the noise (n,) of positions and torques."""

    experiment: Experiment
    forward: AccelerationModel
    measured_motion: MeasuredMotion
    q_noise: Array  # (n,)
    tau_noise: Array

    @property
    def q(self) -> Array:
        """Measured positions (N, n)."""
        return self.measured_motion.q

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    def step(self, states: Array, k: int) -> Array:
        """Predict states (S, k) from sample k to k + 1."""
        n = self.n
        q, v, beta = states[:, :n], states[:, n : 2 * n], states[:, 2 * n :]
        at = np.full(len(states), k)
        q, v = self.forward.along(self.measured_motion, at, beta, (q, v))
        return np.concatenate([q, v, beta], axis=1)

    def process_noise(self, mean: Array) -> Array:
        """Covariance (k, k) that torque noise adds in one step."""
        n = self.n
        q, v, beta = (x[None] for x in np.split(mean, [n, 2 * n]))
        pushed = np.concatenate([np.zeros((1, n)), np.diag(self.tau_noise)])
        a = self.forward.acceleration(beta, q, v, pushed)  # of one state, under n + 1 torques
        # The acceleration is affine in the torque: these are columns of M^-1 times the noise.
        return self.noise_of_push((a[1:] - a[0]).T, len(mean))

    def noise_of_push(self, push: Array, size: int) -> Array:
        """The same (size, size) for `push` (n, n), M^-1 times the deviations of the torques."""
        n, dt = self.n, self.forward.dt
        # Torque noise held over one sample moves v by dt M^-1 w and q by half of dt times that.
        gain = np.concatenate([0.5 * dt**2 * push, dt * push, np.zeros((size - 2 * n, n))])
        return np.asarray(gain @ gain.T)

    def measured(self, belief: FilterEstimate, k: int) -> FilterEstimate:
        """Measurement update with the positions of sample k (Joseph form)."""
        n, P = self.n, belief.covariance
        S = P[:n, :n] + np.diag(self.q_noise**2)
        gain = np.linalg.solve(S, P[:n]).T
        mean = belief.mean + gain @ (self.q[k] - belief.mean[:n])
        keep = np.eye(len(mean))
        keep[:, :n] -= gain
        # Positive semidefinite for any gain; (1 - G H) P loses that to rounding.
        P = keep @ P @ keep.T + (gain * self.q_noise**2) @ gain.T
        return FilterEstimate(mean, 0.5 * (P + P.T))

    def start(self) -> FilterEstimate:
        """State of the first sample, with beta of the prior, else of least squares."""
        n, recording = self.n, self.experiment.recording
        beta, covariance = _first_parameters(self.experiment)
        v = recording.motion.v[0]
        spread = np.concatenate(
            [self.q_noise, 0.1 * np.sqrt((recording.motion.v**2).mean(axis=0)) + 1e-9]
        )
        P = np.zeros((2 * n + len(beta),) * 2)
        P[: 2 * n, : 2 * n] = np.diag(spread**2)
        P[2 * n :, 2 * n :] = covariance
        return FilterEstimate(np.concatenate([self.q[0], v, beta]), P)

    def result(self, belief: FilterEstimate, start: FilterEstimate) -> Estimate:
        """Last estimate; raises EstimationError where it diverges from its start or keeps it."""
        beta, first = belief.mean[2 * self.n :], start.mean[2 * self.n :]
        if not np.isfinite(belief.mean).all() or np.array_equal(beta, first):
            raise EstimationError("The filter's state is not finite, or it has not left its start.")
        R = stacked_factor(self.experiment.problem)
        # Distances in torque: what hardly acts on it may go far without any divergence.
        if step_rms(R, beta - first) > 100 * step_rms(R, first):
            raise EstimationError("The filter diverges from its start: the noise is too large.")
        part = slice(2 * self.n, None)
        return Estimate(beta, covariance=belief.covariance[part, part])


def joint_filter(experiment: Experiment, what: str, substeps: int) -> JointFilter:
    """Return the model of a joint filter on the raw samples that filtering kept."""
    scalar_joints(experiment, what)
    measured = measured_motion(experiment)
    tau, noise = measured.tau, []
    for x, share in zip((measured.q, tau), NOISE_FLOOR, strict=True):
        size = np.sqrt((x**2).mean(axis=0))
        # A joint that hardly moves has a floor as well: a tenth of that of the largest.
        least = np.maximum(share * size, 0.1 * share * size.max())
        noise.append(np.maximum(white_noise(x), least))
    q_noise, tau_noise = noise
    # The error of linear interpolation between samples counts as torque noise.
    tau_noise = np.hypot(tau_noise, np.sqrt((np.diff(tau, 2, axis=0) ** 2).mean(axis=0)) / 8)
    if experiment.moving is not None:
        beta, known = solve(stacked_factor(experiment.problem)), experiment.known(measured.motion)
        e = tau - known - regressor_of(experiment, measured.motion) @ beta
        e[measured.standing] = 0.0
        # White noise as strong at low frequencies as the residual of least squares: its deviation
        # times the root of its autocorrelation time, summed to the first zero (Geyer 1992).
        misfit = np.array([np.sqrt((x**2).mean() * correlation_time(x)) for x in e.T])
        tau_noise = np.maximum(tau_noise, misfit)
    forward = AccelerationModel(experiment, 1 / measured.rate, substeps)
    return JointFilter(experiment, forward, measured, q_noise, tau_noise)


def _first_parameters(experiment: Experiment) -> tuple[Array, Array]:
    """Mean (r,) and covariance (r, r) of beta before the first sample."""
    problem = experiment.problem
    K = problem.base.K
    if problem.prior is not None and experiment.moving is None:
        spread = K * problem.prior.std
        # K std K' is singular where the prior is certain of a combination.
        floor = 1e-12 * np.trace(spread @ spread.T) * np.eye(len(K))
        return K @ problem.prior.theta, spread @ spread.T + floor
    W, b = dense_rows(problem)
    rms = np.sqrt((b**2).mean(axis=0))
    sigma = np.where(rms > 0, rms, 1.0)
    R = residual_factor(W / sigma[:, None], b / sigma)
    r = len(K)
    beta = solve(R)
    if experiment.moving is not None:
        # A state-space model needs a mass matrix, which a beta of no bodies may not have.
        beta = K @ feasible_start(problem)
    # Rows have unit RMS: an error of START_ERROR of the torque, in all samples alike.
    inverse = np.linalg.inv(R[:r, :r]) * START_ERROR * np.sqrt(len(b))
    return beta, inverse @ inverse.T


class _NonlinearFilter(ABC):
    """One pass of a filter over the measured positions."""

    bias: ClassVar[str] = "torques between samples are interpolated linearly"
    substeps: int

    def fit(self, experiment: Experiment) -> Estimate:
        """Return the estimate after the last sample; raises EstimationError where the filter
        diverges, UnsupportedError for joints without scalar positions."""
        model = joint_filter(experiment, f"The {type(self).__name__}", self.substeps)
        start = belief = model.measured(model.start(), 0)
        unscented = self.weights(len(start.mean))
        steps = compiled_steps(model.forward, model.measured_motion) if filters_library() else None
        if steps is not None:
            noise, state = (model.q_noise, model.tau_noise), (start.mean, start.covariance)
            belief = FilterEstimate(*run_filter(steps, model.q, noise, state, unscented))
            return model.result(belief, start)
        for k in range(len(model.q) - 1):
            belief = model.measured(self._predicted(model, belief, k), k + 1)
        return model.result(belief, start)

    def weights(self, size: int) -> tuple[float, float] | None:
        """Return those of sigma points; None for a filter without."""
        return None

    @abstractmethod
    def _predicted(self, model: JointFilter, belief: FilterEstimate, k: int) -> FilterEstimate:
        """State of sample k + 1 before its measurement, from that of sample k."""


@dataclass(frozen=True)
class EKF(_NonlinearFilter):
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

    substeps: int = 1

    def _predicted(self, model: JointFilter, belief: FilterEstimate, k: int) -> FilterEstimate:
        n, mean = model.n, belief.mean
        sensitive = SensitivityModel(model.forward, model.measured_motion, mean[2 * n :])
        start = start_state(mean[None, :n], mean[None, n : 2 * n], len(mean) - 2 * n)
        x = sensitive.step(start, np.array([k]))
        # Process noise of beta is zero: a constant only becomes more certain.
        F = np.eye(len(mean))
        F[: 2 * n] = np.concatenate([x.dq[0], x.dv[0]])
        assert x.M is not None
        push = np.linalg.solve(x.M[0], np.diag(model.tau_noise))
        P = F @ belief.covariance @ F.T + model.noise_of_push(push, len(mean))
        return FilterEstimate(np.concatenate([x.q[0], x.v[0], mean[2 * n :]]), 0.5 * (P + P.T))


@dataclass(frozen=True)
class UKF(_NonlinearFilter):
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
    substeps: int = 1

    def __post_init__(self) -> None:
        """Raise UsageError unless alpha is positive."""
        if not self.alpha > 0:
            raise UsageError(f"alpha = {self.alpha}: give a positive number.")

    def weights(self, size: int) -> tuple[float, float]:
        """Return the spread L + lambda of states of a size, and the further weight of the centre.

        Raises UsageError for a kappa that leaves no spread.
        """
        spread = self.alpha**2 * (size + self.kappa)  # L + lambda
        if spread <= 0:
            raise UsageError(
                f"kappa = {self.kappa}: give a number above {-size}, minus the states."
            )
        return spread, self.beta - self.alpha**2

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
        spread, further = self.weights(L)
        root = np.sqrt(spread) * _root(covariance).T
        points = function(mean + np.concatenate([np.zeros((1, L)), root, -root]))
        weights = np.full(2 * L + 1, 0.5 / spread)
        weights[0] = 1 - L / spread
        # About the centre: the weights sum to one, and large ones cancel exactly.
        away = points - points[0]
        shift = weights @ away
        away = away - shift
        weights[0] += 1 + further
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
    raise EstimationError(INDEFINITE)
