"""IDIM-IV: instrumental variables from the simulated closed loop."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError
from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.simulation_based.gauss_newton import (
    FLAT,
    HALVINGS,
    SETTLED,
    floor_of,
    has_converged,
    places_of,
    regressor_along,
    requires_controller,
    sample_at,
    sigmas,
    step_length,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording, Trajectory

WEAK = 1e-6
"""Instruments whose weakest direction correlates less than this share of the strongest tell
nothing about it."""

SHRINKS = 0.5
"""Steps that do not shrink to this share of the one before go to and fro: half of them is taken."""


@dataclass(frozen=True)
class IV:
    """beta = (Z' S^-1 W)^-1 Z' S^-1 b (Janot, Vandanjon, Gautier 2014).

    W is the regressor of the measured motion, as the suite filters it; the instruments Z are the
    regressor along a noise-free simulation of the model under the declared controller with the
    beta before, so that they correlate with the motion but not with its noise. S is the residual
    variance of each joint. Iterated until the simulation no longer changes; where the bodies of a
    beta cannot exist, the nearest that can are simulated. Assumes the controller as declared.
    """

    iterations: int = 20

    def fit(self, experiment: Experiment) -> Estimate:
        """The estimate; raises EstimationError where the iteration does not settle."""
        room, theta = requires_controller(experiment)
        W, b = _measured(experiment)
        floor = floor_of(b)
        sigma = sigmas(b, floor)
        simulated = experiment.simulate(theta)
        share, before = 1.0, np.inf
        for count in range(1, self.iterations + 1):
            Z = regressor_along(experiment, _same_times(simulated, experiment))
            for _ in range(2):  # with the residual's own size per joint
                beta, R, Q_W = _solution(Z, W, b, sigma)
                sigma = sigmas(b - W @ beta, floor)
            goal = _goal(room, theta, beta, R)
            moved = room.problem.base.K @ (goal - theta)
            if has_converged(R, moved, beta, SETTLED if count < 0.5 * self.iterations else FLAT):
                inverse = np.linalg.inv(Q_W)
                return Estimate(
                    beta, covariance=inverse @ inverse.T, stats={"iterations": float(count)}
                )
            if step_length(R, moved) > SHRINKS * before:  # it goes to and fro
                share *= 0.5
            before = step_length(R, moved)
            theta, simulated = _towards(theta + share * (goal - theta), theta, experiment)
        raise EstimationError(
            f"{self.iterations} iterations did not settle: the last moved the simulated base "
            f"parameters by {step_length(R, moved):.3g} standard deviations; the noise is too "
            "large."
        )


def _measured(experiment: Experiment) -> tuple[Array, Array]:
    """W (N, rows, r) and b (N, rows)."""
    parts = list(experiment.problem.blocks())
    return np.concatenate([W for W, _ in parts]), np.concatenate([b for _, b in parts])


def _same_times(simulated: Recording, experiment: Experiment) -> Trajectory:
    """The simulated motion at the samples that filtering left."""
    return sample_at(simulated.motion, places_of(experiment.recording.t, simulated.t))


def _solution(Z: Array, W: Array, b: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """beta, R of the whitened instruments, and Q'W of them."""
    r = W.shape[-1]
    white = (1.0 / sigma)[:, None]
    Q, R = np.linalg.qr((Z * white).reshape(-1, r))
    Q_W = Q.T @ (W * white).reshape(-1, r)
    size = np.linalg.norm(Q_W, axis=0)
    if not np.isfinite(Q_W).all() or (size == 0).any() or np.linalg.cond(Q_W / size) > 1 / WEAK:
        raise EstimationError(
            "The simulated motion does not correlate with the measured one in every direction: "
            "the noise is too large, or the motion excites too little."
        )
    return np.linalg.solve(Q_W, Q.T @ (b / sigma).ravel()), R, Q_W


def _goal(room: SimulatableSet, theta: Array, beta: Array, R: Array) -> Array:
    exact = room.project_exact(theta, beta)
    return exact if exact is not theta else room.nearest(beta, R)


def _towards(goal: Array, theta: Array, experiment: Experiment) -> tuple[Array, Recording]:
    """The farthest of the halved steps to `goal` that can be simulated."""
    for times in range(HALVINGS):
        moved = theta + 0.5**times * (goal - theta)
        try:
            return moved, experiment.simulate(moved)
        except (EstimationError, SimulationError) as error:
            reason = error
    raise EstimationError(f"No step can be simulated. The last: {reason}")
