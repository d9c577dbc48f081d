"""Joint state and parameter filters: the state [q v beta], its start and its noise."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.correlation import correlation_time
from sysid_bench.errors import EstimationError
from sysid_bench.identification.linear.least_squares import solve, stacked_factor
from sysid_bench.identification.linear.white_noise import white_noise
from sysid_bench.identification.simulation_based.acceleration_model import (
    AccelerationModel,
    scalar_joints,
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
)
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
        return self._process_noise((a[1:] - a[0]).T, len(mean))

    def process_noise_of(self, M: Array, size: int) -> Array:
        """The same (size, size) for a known mass matrix M (n, n)."""
        return self._process_noise(np.linalg.solve(M, np.diag(self.tau_noise)), size)

    def _process_noise(self, push: Array, size: int) -> Array:
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
        beta, covariance = _begin(self.experiment)
        v = recording.motion.v[0]
        spread = np.concatenate(
            [self.q_noise, 0.1 * np.sqrt((recording.motion.v**2).mean(axis=0)) + 1e-9]
        )
        P = np.zeros((2 * n + len(beta),) * 2)
        P[: 2 * n, : 2 * n] = np.diag(spread**2)
        P[2 * n :, 2 * n :] = covariance
        return FilterEstimate(np.concatenate([self.q[0], v, beta]), P)

    def result(self, belief: FilterEstimate, start: FilterEstimate) -> Estimate:
        """Estimate of the last state;
        raises EstimationError where it diverged or kept its start."""
        beta, first = belief.mean[2 * self.n :], start.mean[2 * self.n :]
        if not np.isfinite(belief.mean).all() or np.array_equal(beta, first):
            raise EstimationError("The filter's state is not finite, or it has not left its start.")
        R = stacked_factor(self.experiment.problem)
        if step_rms(R, beta - first) > 100 * step_rms(R, first):
            raise EstimationError("The filter diverges from its start: the noise is too large.")
        part = slice(2 * self.n, None)
        return Estimate(beta, covariance=belief.covariance[part, part])


def joint_filter(experiment: Experiment, what: str, substeps: int) -> JointFilter:
    """Return the model of a joint filter on the raw samples that filtering kept."""
    scalar_joints(experiment, what)
    measured = measured_motion(experiment)
    q, tau = measured.q, measured.tau
    sizes = [np.sqrt((x**2).mean(axis=0)) for x in (q, tau)]
    least = [
        # A joint that hardly moves has a floor as well: a tenth of that of the largest.
        np.maximum(share * x, 0.1 * share * x.max())
        for share, x in zip(NOISE_FLOOR, sizes, strict=True)
    ]
    q_noise, tau_noise = (
        np.maximum(white_noise(x), at_least) for x, at_least in zip((q, tau), least, strict=True)
    )
    # The error of linear interpolation between samples counts as torque noise.
    tau_noise = np.hypot(tau_noise, np.sqrt((np.diff(tau, 2, axis=0) ** 2).mean(axis=0)) / 8)
    if experiment.moving is not None:
        tau_noise = np.maximum(tau_noise, _misfit(experiment, measured))
    forward = AccelerationModel(experiment, 1 / measured.rate, substeps)
    return JointFilter(experiment, forward, measured, q_noise, tau_noise)


def _misfit(experiment: Experiment, measured: MeasuredMotion) -> Array:
    """White noise (n,) as strong at low frequencies as the residual of least squares: its deviation
    times the root of its autocorrelation time, summed to the first zero (Geyer 1992)."""
    beta = solve(stacked_factor(experiment.problem))
    known = experiment.known(measured.motion)
    e = measured.tau - known - regressor_of(experiment, measured.motion) @ beta
    e[measured.standing] = 0.0
    return np.array([np.sqrt((x**2).mean() * correlation_time(x)) for x in e.T])


def _begin(experiment: Experiment) -> tuple[Array, Array]:
    problem = experiment.problem
    K = problem.base.K
    if problem.prior is not None and experiment.moving is None:
        spread = K * problem.prior.std
        # K std K' is singular where the prior is certain of a combination.
        floor = 1e-12 * np.trace(spread @ spread.T) * np.eye(len(K))
        return K @ problem.prior.theta, spread @ spread.T + floor
    parts = list(problem.blocks())
    W, b = (np.concatenate(x) for x in zip(*parts, strict=True))
    sigma = np.sqrt((b**2).mean(axis=0))
    R = residual_factor(
        W / np.where(sigma > 0, sigma, 1.0)[:, None], b / np.where(sigma > 0, sigma, 1.0)
    )
    r = len(K)
    beta = solve(R)
    if experiment.moving is not None:
        # A state-space model needs a mass matrix, which a beta of no bodies may not have.
        beta = K @ feasible_start(problem)
    # Rows have unit RMS: an error of START_ERROR of the torque, in all samples alike.
    inverse = np.linalg.inv(R[:r, :r]) * START_ERROR * np.sqrt(len(b))
    return beta, inverse @ inverse.T
