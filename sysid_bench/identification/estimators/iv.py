"""IDIM-IV: instrumental variables from the simulated closed loop."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.simulation_based.gauss_newton import (
    CONVERGED,
    FLAT,
    HALVINGS,
    error_noise,
    floor_of,
    has_converged,
    indices_of,
    regressor_of,
    samples_of,
    simulatable_start,
    step_rms,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording, Trajectory

WEAK = 1e-6
"""Smallest ratio of singular values of Q'W, unit columns: below it the instruments are weak."""

SHRINKS = 0.5
"""A step longer than this share of the previous one oscillates: the step length is halved."""


@dataclass(frozen=True)
class IV:
    """beta = (Z' S^-1 W)^-1 Z' S^-1 b (Janot, Vandanjon, Gautier 2014).

    W is the regressor of the measured, filtered motion; the instruments Z are the regressor along a
    noise-free simulation under the declared controller with the previous beta: correlated with the
    motion, not with its noise. Rows of both are processed alike. S is the residual variance per
    joint. Where no physical bodies have this beta, the nearest are simulated. Stops at a change
    below 0.1 standard deviations (0.3 in the second half of 20 iterations; the problems of the
    conformance kit take 2). Assumes the controller as declared.
    """

    iterations: int = 20

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the iteration does not
        converge or the instruments are weak, UnsupportedError where the recording declares no
        controller."""
        simulatable, theta = simulatable_start(experiment)
        W, b = _measured(experiment)
        floor = floor_of(b)
        sigma = error_noise(b, floor)
        simulated = experiment.simulate(theta)
        share, before = 1.0, np.inf
        for count in range(1, self.iterations + 1):
            Z = regressor_of(experiment, _same_times(simulated, experiment))
            Z = experiment.filter_rows(Z)
            for _ in range(2):  # the second with the residual variance of the first
                beta, R, Q_W = _solution(Z, W, b, sigma)
                sigma = error_noise(b - W @ beta, floor)
            goal = _goal(simulatable, theta, beta, R)
            moved = simulatable.problem.base.K @ (goal - theta)
            if has_converged(R, moved, beta, CONVERGED if count < 0.5 * self.iterations else FLAT):
                inverse = np.linalg.inv(Q_W)
                return Estimate(
                    beta, covariance=inverse @ inverse.T, stats={"iterations": float(count)}
                )
            if step_rms(R, moved) > SHRINKS * before:
                share *= 0.5
            before = step_rms(R, moved)
            theta, simulated = _towards(theta + share * (goal - theta), theta, experiment)
        raise EstimationError(
            f"The method did not converge in {self.iterations} iterations: the last changed the "
            f"base parameters by {step_rms(R, moved):.3g} standard deviations; the noise is "
            "too large."
        )


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


def _goal(simulatable: SimulatableSet, theta: Array, beta: Array, R: Array) -> Array:
    exact = simulatable.with_base(theta, beta)
    return exact if exact is not theta else simulatable.nearest(beta, R)


def _towards(goal: Array, theta: Array, experiment: Experiment) -> tuple[Array, Recording]:
    """Largest of the halved steps towards `goal` that can be simulated."""
    for times in range(HALVINGS):
        moved = theta + 0.5**times * (goal - theta)
        try:
            return moved, experiment.simulate(moved)
        except (EstimationError, SimulationError) as error:
            reason = error
    raise EstimationError(f"No step can be simulated. The last: {reason}")
