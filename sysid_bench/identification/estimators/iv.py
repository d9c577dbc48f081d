"""IDIM-IV: instrumental variables from the simulated closed loop."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import EstimationError, UsageError
from sysid_bench.identification.simulation_based.gauss_newton import (
    error_noise,
    floor_of,
    indices_of,
    regressor_of,
    samples_of,
    simulatable_start,
)
from sysid_bench.identification.simulation_based.published_fit import (
    LinearFit,
    PublishedFit,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording, Trajectory

WEAK = 1e-6
"""Smallest ratio of singular values of Q'W, unit columns: below it the instruments are weak."""


@dataclass(frozen=True)
class IV:
    """beta = (Z' S^-1 W)^-1 Z' S^-1 b (Janot, Vandanjon, Gautier 2014).

    W is the regressor of the measured, filtered motion; the instruments Z are the regressor along a
    noise-free simulation under the declared controller with the previous beta: correlated with the
    motion, not with its noise. Rows of both are processed alike. S is the residual variance per
    joint. Starts from the prior, else from least squares along the commanded motion. Stops as
    published, where the residual norm and the significant parameters change by at most `tolerance`
    = 2.5 %, or after 10 iterations.

    Deviations: the simulator needs physically consistent bodies, so that the nearest to beta are
    simulated; gains are those declared; the change counts for parameters with a relative standard
    deviation below 10 %. Where an iterate cannot be simulated, the previous one is the estimate.
    Assumes the controller as declared.
    """

    tolerance: float = 0.025
    iterations: int = 10

    def __post_init__(self) -> None:
        """Raise UsageError for iterations below 1."""
        if self.iterations < 1:
            raise UsageError("iterations is a whole number of 1 or more.")

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the first iterate cannot be
        simulated, the instruments are weak or the iteration diverges, UnsupportedError where the
        recording declares no controller."""
        simulatable, start = simulatable_start(experiment)
        fit = _Fit(experiment, *_measured(experiment))
        return PublishedFit(
            simulatable, experiment.simulate, fit, self.tolerance, self.iterations
        ).run(start)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Instrumental variables on the measured W (N, rows, r) and b (N, rows)."""

    experiment: Experiment
    W: Array
    b: Array

    def __call__(self, simulated: Recording) -> LinearFit:
        Z = regressor_of(self.experiment, _same_times(simulated, self.experiment))
        Z = self.experiment.filter_rows(Z)
        floor = floor_of(self.b)
        size = sigma = error_noise(self.b, floor)
        for _ in range(2):  # the second with the residual variance of the first
            beta, R, Q_W = _solution(Z, self.W, self.b, sigma)
            rest = self.b - self.W @ beta
            sigma = error_noise(rest, floor)
        inverse = np.linalg.inv(Q_W)
        residual = float(np.linalg.norm(rest / size) / np.linalg.norm(self.b / size))
        return LinearFit(beta, inverse @ inverse.T, R, residual)


def _measured(experiment: Experiment) -> tuple[Array, Array]:
    """Measured W (N, rows, r) and b (N, rows)."""
    parts = list(experiment.problem.blocks())
    return np.concatenate([W for W, _ in parts]), np.concatenate([b for _, b in parts])


def _same_times(simulated: Recording, experiment: Experiment) -> Trajectory:
    """Simulated motion at the samples of the filtered recording."""
    return samples_of(simulated.motion, indices_of(experiment.recording.t, simulated.t))


def _solution(Z: Array, W: Array, b: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """beta (r,), the QR factor R of the whitened instruments, and Q'W (r, r)."""
    r = W.shape[-1]
    white = (1.0 / sigma)[:, None]
    # Z' W through Q: the normal equations would square the condition of Z.
    Q, R = np.linalg.qr((Z * white).reshape(-1, r))
    Q_W = Q.T @ (W * white).reshape(-1, r)
    size = np.linalg.norm(Q_W, axis=0)
    if not np.isfinite(Q_W).all() or (size == 0).any() or np.linalg.cond(Q_W / size) > 1 / WEAK:
        raise EstimationError(
            "The simulated motion does not correlate with the measured one in every direction: "
            "the noise is too large, or the motion excites too little."
        )
    return np.linalg.solve(Q_W, Q.T @ (b / sigma).ravel()), R, Q_W
