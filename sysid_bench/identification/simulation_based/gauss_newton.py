"""Gauss-Newton on simulated motions, guarded: what DIDIM, output and input error share.

A trial is a theta that can be simulated, and what the model then does otherwise than the robot.
Every step stays among possible bodies, is halved until the data are explained better, and a fit
that does not settle or never left its start says so.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.linalg import lapack, solve_triangular

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
from sysid_bench.identification.feasibility.simulatable import SimulatableSet, simulatable_set
from sysid_bench.identification.linear.normal_qr import solve
from sysid_bench.types import Array, Estimate, Experiment, Recording, Trajectory

SETTLED: Final = 0.1
"""A step is none where it moves beta by less than this share of a standard deviation."""

FLAT: Final = 0.3
"""Share of a standard deviation below which a step may fail to explain the data better."""

REPEATS: Final = 1e-8
"""Relative size of such a step in exact data: simulations repeat no better."""

NEAREST: Final = 1e-5
"""The same where beta belongs to no bodies that exist, and the nearest that do are taken."""

ROUNDING: Final = 1e-11
"""Errors below this share of a signal's RMS are rounding, and steps below it change nothing."""

HALVINGS: Final = 6
"""Of a step before it is given up: 1/64 of it explains nothing better."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate: theta (p,), its base parameters, the simulation if there is one, and
    `error` (M, channels), what the model does otherwise than the robot."""

    theta: Array
    beta: Array
    error: Array
    recording: Recording | None = None


class Model(Protocol):
    """What is compared: `attempt` raises EstimationError or SimulationError for a theta that
    cannot be; `slope` (M, channels, r) is minus the error's derivative by beta; `floor`
    (channels,) the RMS below which an error is rounding. Where the slope `approximates`, what
    steps show of the rest is learnt on the way."""

    approximates: bool

    @property
    def floor(self) -> Array: ...
    def evaluate(self, theta: Array) -> Candidate: ...
    def jacobian(self, trial: Candidate) -> Array: ...


@dataclass(frozen=True)
class GaussNewton:
    """Settings of the iteration."""

    iterations: int = 40

    def run(self, model: Model, room: SimulatableSet, start: Array) -> Estimate:
        """The estimate from a start (p,); raises EstimationError where it does not settle."""
        trial = model.evaluate(start)
        learnt: Array | None = None
        steps = halvings = 0
        for _ in range(self.iterations):
            sigma = sigmas(trial.error, model.floor)
            slope = model.jacobian(trial) if learnt is None else model.jacobian(trial) + learnt
            R = accumulated_factor(slope / sigma[:, None], trial.error / sigma)
            goal, inside = _goal(room, trial, R)
            moved = room.problem.base.K @ (goal - trial.theta)
            if has_converged(R, moved, trial.beta):
                return self._answer(trial, R, steps, halvings)
            tries = 2 if has_converged(R, moved, trial.beta, FLAT) else HALVINGS
            better, times = _better(model, trial, goal, tries)
            halvings += times
            if better is not None:
                if model.approximates:
                    more = _unforeseen(slope, R, trial, better)
                    learnt = more if learnt is None else learnt + more
                trial, steps = better, steps + 1
            elif learnt is not None:  # what was learnt misleads here
                learnt = None
            elif has_converged(R, moved, trial.beta, FLAT, REPEATS if inside else NEAREST):
                return self._answer(trial, R, steps, halvings)
            else:
                raise EstimationError(
                    f"No step along the search direction explains the data better, after {steps} "
                    "that did: the model does not fit the data, or the noise is too large."
                )
        raise EstimationError(
            f"{self.iterations} steps did not settle: the last moved the base parameters by "
            f"{step_length(R, moved):.3g} standard deviations; the noise is too large, or the "
            "start too far."
        )

    def _answer(self, trial: Candidate, R: Array, steps: int, halvings: int) -> Estimate:
        return Estimate(
            trial.beta,
            covariance=covariance(R),
            stats={"steps": float(steps), "halvings": float(halvings)},
        )


def _unforeseen(slope: Array, R: Array, trial: Candidate, after: Candidate) -> Array:
    """What a step showed of the slope that was not foreseen, (M, channels, r): Broyden's update in
    the metric of the data. A slope that leaves something out still finds the end quickly."""
    moved, r = after.beta - trial.beta, len(trial.beta)
    dual = R[:r, :r].T @ (R[:r, :r] @ moved)
    missed = trial.error - after.error - slope @ moved
    return missed[..., None] * (dual / (dual @ moved))


def _goal(room: SimulatableSet, trial: Candidate, R: Array) -> tuple[Array, bool]:
    """Where a full step leads among the possible, theta (p,), and whether all of it is possible."""
    r = len(trial.beta)
    wanted = trial.beta + solve(R)
    exact = room.project_exact(trial.theta, wanted)
    if exact is not trial.theta:
        return exact, True
    nearest = room.nearest(wanted, R[:r, :r])
    miss = step_length(R, room.problem.base.K @ nearest - wanted)
    return nearest, miss <= REPEATS * step_length(R, wanted)


def _better(
    model: Model, trial: Candidate, goal: Array, tries: int
) -> tuple[Candidate | None, int]:
    """The first of the halved steps to `goal` that explains the data better, and the halvings."""
    now = _log_likelihood(trial.error, model.floor)
    for times in range(tries):
        theta = trial.theta + 0.5**times * (goal - trial.theta)
        try:
            after = model.evaluate(theta)
        except (EstimationError, SimulationError):
            continue
        if _log_likelihood(after.error, model.floor) > now:
            return after, times
    return None, tries


def _log_likelihood(error: Array, floor: Array) -> float:
    """Of white noise of unknown size per channel, up to a constant."""
    return -float(len(error) * np.log(sigmas(error, floor)).sum())


def sigmas(error: Array, floor: Array) -> Array:
    """RMS (channels,) of the errors, at least the floor; 1 where a channel never moves."""
    size = np.maximum(np.sqrt((error**2).mean(axis=0)), floor)
    return np.where(size > 0, size, 1.0)


def floor_of(signal: Array) -> Array:
    """The RMS (channels,) below which an error of this signal is rounding."""
    return ROUNDING * np.sqrt((signal**2).mean(axis=0))


def accumulated_factor(J: Array, e: Array) -> Array:
    """R (r + 1, r + 1) of [J | e], J (M, channels, r), e (M, channels)."""
    r = J.shape[-1]
    stack = np.zeros((max(e.size, r + 1), r + 1), order="F")
    stack[: e.size, :r], stack[: e.size, r] = J.reshape(-1, r), e.ravel()
    packed, _, _, _ = lapack.dgeqrf(stack, lwork=64 * (r + 1), overwrite_a=1)
    return np.triu(packed[: r + 1])


def has_converged(
    R: Array, moved: Array, beta: Array, share: float = SETTLED, rounding: float = ROUNDING
) -> bool:
    """Whether a step (r,) is small against the noise, or against rounding."""
    return step_length(R, moved) <= max(share, rounding * step_length(R, beta))


def step_length(R: Array, moved: Array) -> float:
    """A step in standard deviations of its most probable length."""
    r = len(moved)
    return float(np.linalg.norm(R[:r, :r] @ moved) / np.sqrt(max(r, 1)))


def covariance(R: Array) -> Array:
    """(J'J)^-1 of whitened rows, (r, r)."""
    r = len(R) - 1
    inverse = solve_triangular(R[:r, :r], np.eye(r))
    return inverse @ inverse.T


def start_of(experiment: Experiment, room: SimulatableSet) -> Array:
    """Where to begin (p,): the prior, or what least squares finds along the commanded motion, whose
    regressor knows no noise."""
    problem = experiment.problem
    if problem.prior is not None:
        return room.centre
    raw, commanded = experiment.raw, _commanded_of(experiment)
    tau = rows_of(experiment, raw.tau) - experiment.known(commanded)
    W = regressor_along(experiment, commanded)
    sigma = np.ones(tau.shape[1])
    for _ in range(2):
        R = accumulated_factor(W / sigma[:, None], tau / sigma)
        beta = solve(R)
        sigma = sigmas(tau - W @ beta, floor_of(tau))
    return room.nearest(beta, R[:-1, :-1])


def _commanded_of(experiment: Experiment) -> Trajectory:
    """The commanded motion at the recorded times; raises UnsupportedError where there is none."""
    raw = experiment.raw
    if raw.commanded is None or raw.controller is None:
        raise UnsupportedError("This recording declares no controller: nothing to simulate with.")
    return sample_at(raw.commanded, places_of(raw.t, raw.commanded.t))


def sample_at(motion: Trajectory, places: Array) -> Trajectory:
    """Some samples of a motion."""
    return Trajectory(
        motion.t[places], motion.q[places], motion.v[places], motion.a[places], motion.name
    )


def places_of(t: Array, grid: Array) -> Array:
    """Where the times t (M,) lie in a grid (N,) that holds them."""
    return np.searchsorted(grid, t - 0.5 * (grid[1] - grid[0]))


def regressor_along(experiment: Experiment, motion: Trajectory) -> Array:
    """The base regressor (N, rows, r) along a motion."""
    return np.concatenate(list(experiment.regress(motion)))


def rows_of(experiment: Experiment, tau: Array) -> Array:
    """Of torques (N, nv) those that the task measures, (N, rows)."""
    names = experiment.raw.rows
    return tau[:, [names.index(row) for row in experiment.problem.rows]]


def requires_controller(experiment: Experiment) -> tuple[SimulatableSet, Array]:
    """Room for steps and the start of a method that simulates the closed loop."""
    _commanded_of(experiment)
    room = simulatable_set(experiment.problem)
    return room, start_of(experiment, room)
