"""Gauss-Newton on simulated motions, for guarded DIDIM, input error, output error and multiple
shooting.

Iterates are physically consistent theta; steps are halved until the likelihood increases. A fit
that does not converge returns its last iterate and says so; one that makes no step at all raises
EstimationError.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.linalg import lapack

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
from sysid_bench.identification.feasibility.simulatable import SimulatableSet, simulatable_set
from sysid_bench.identification.linear.least_squares import covariance, solve
from sysid_bench.identification.optimisers import BudgetError
from sysid_bench.types import Array, Estimate, Experiment, Recording, Trajectory

CONVERGED: Final = 0.1
"""Step length at convergence, in standard deviations of beta."""

FLAT: Final = 0.3
"""Step length, in standard deviations, below which a step may fail to increase the likelihood."""

REPEATS: Final = 1e-8
"""Relative length of such a step for exact data: the accuracy of simulations."""

NEAREST: Final = 1e-5
"""The same where beta is infeasible and the nearest feasible one is used."""

ROUNDING: Final = 1e-11
"""Rounding error relative to a signal's RMS."""

HALVINGS: Final = 6
"""Most halvings of a step."""

SMALL: Final = "the step is small against the noise"
NO_STEP: Final = "no step increases the likelihood"


@dataclass(frozen=True, eq=False)
class ModelResult:
    """Iterate: theta (p,), its base parameters, the simulation if there is one, and `error` (M,
    channels), measured minus simulated signal."""

    theta: Array
    beta: Array
    error: Array
    recording: Recording | None = None


class Model(Protocol):
    """Compared signals. `evaluate` raises EstimationError or SimulationError for an infeasible
    theta; `jacobian` (M, channels, r) is minus the derivative of the error by beta; `floor`
    (channels,) the RMS of rounding errors. An `approximates` Jacobian is corrected by Broyden
    updates; where it finds no further step, or after half of the iterations, the same signals with
    an `exact` one go on (None: it decides)."""

    @property
    def approximates(self) -> bool: ...
    @property
    def exact(self) -> "Model | None": ...

    @property
    def floor(self) -> Array: ...
    def evaluate(self, theta: Array) -> ModelResult: ...
    def jacobian(self, trial: ModelResult) -> Array: ...


@dataclass(eq=False)
class _Progress:
    """Last accepted iterate, R (r + 1, r + 1) of its Jacobian (None: not computed yet), accepted
    steps and halvings."""

    trial: ModelResult
    R: Array | None = None
    steps: int = 0
    halvings: int = 0

    def estimate(self, converged: bool, stop: str) -> Estimate:
        """The last accepted iterate, at worst the start."""
        return Estimate(
            self.trial.beta,
            covariance=None if self.R is None else covariance(self.R),
            stats={"halvings": float(self.halvings)},
            converged=converged,
            iterations=self.steps,
            stop=stop,
        )

    def moved(self, converged: bool, stop: str) -> Estimate:
        """The same; raises EstimationError for a start that was not improved, nor has converged."""
        if not converged and not self.steps:
            raise EstimationError(
                f"The method has not left its start ({stop}): the model does not fit the data, or "
                "the noise is too large."
            )
        return self.estimate(converged, stop)


@dataclass(frozen=True)
class GaussNewton:
    """Settings of the iteration."""

    iterations: int = 40

    def run(self, model: Model, simulatable: SimulatableSet, start: Array) -> Estimate:
        """Return the estimate from a start (p,), at the end of a budget the last accepted iterate;
        raises EstimationError where no step increases the likelihood of the start."""
        progress = _Progress(ModelResult(start, simulatable.problem.base.K @ start, np.zeros(0)))
        try:
            progress.trial = model.evaluate(start)
            return self._iterate(model, simulatable, progress)
        except BudgetError as spent:
            return progress.estimate(False, str(spent))

    def _iterate(self, model: Model, simulatable: SimulatableSet, progress: _Progress) -> Estimate:
        correction: Array | None = None
        for k in range(self.iterations):
            if 2 * k == self.iterations and model.exact is not None:
                model, correction = model.exact, None
            trial = progress.trial
            sigma = error_noise(trial.error, model.floor)
            jacobian = _plus(model.jacobian(trial), correction)
            R = residual_factor(jacobian / sigma[:, None], trial.error / sigma)
            progress.R = R
            goal, inside = _goal(simulatable, trial, R)
            change = simulatable.problem.base.K @ (goal - trial.theta)
            if has_converged(R, change, trial.beta):
                if correction is None or step_rms(R, change) <= CONVERGED:
                    if model.exact is None:
                        return progress.moved(True, SMALL)
                    model = model.exact
                # Small against rounding by a corrected Jacobian: the analytical one decides.
                correction = None
                continue
            # A step within the noise fails where the objective is flat: it is halved once at most.
            tries = 2 if has_converged(R, change, trial.beta, FLAT) else HALVINGS
            better, times = _better(model, trial, goal, tries)
            progress.halvings += times
            if better is not None:
                if model.approximates:
                    correction = _plus(_broyden_update(jacobian, R, trial, better), correction)
                progress.trial, progress.steps = better, progress.steps + 1
            elif correction is not None:  # restart from the analytical Jacobian
                correction = None
            elif model.exact is not None:
                model = model.exact
            else:
                flat = has_converged(R, change, trial.beta, FLAT, REPEATS if inside else NEAREST)
                return progress.moved(flat, NO_STEP)
        last = f"the last step was {step_rms(R, change):.3g} standard deviations"
        return progress.moved(False, f"the limit of {self.iterations} iterations; {last}")


def _plus(value: Array, correction: Array | None) -> Array:
    return value if correction is None else value + correction


def _broyden_update(jacobian: Array, R: Array, trial: ModelResult, after: ModelResult) -> Array:
    """Broyden's rank-one correction (M, channels, r) of the Jacobian, in the metric of the data: it
    restores fast convergence of an approximate Jacobian."""
    change, r = after.beta - trial.beta, len(trial.beta)
    # Secant equation: the corrected Jacobian explains the step just made, and changes least.
    dual = R[:r, :r].T @ (R[:r, :r] @ change)
    missed = trial.error - after.error - jacobian @ change
    return np.asarray(missed[..., None] * (dual / (dual @ change)))


def _goal(simulatable: SimulatableSet, trial: ModelResult, R: Array) -> tuple[Array, bool]:
    """theta (p,) after a full step within the feasible set, and whether the step was feasible."""
    r = len(trial.beta)
    wanted = trial.beta + solve(R)
    exact = simulatable.with_base(trial.theta, wanted)
    if exact is not trial.theta:
        return exact, True
    nearest = simulatable.nearest(wanted, R[:r, :r])
    miss = step_rms(R, simulatable.problem.base.K @ nearest - wanted)
    return nearest, miss <= REPEATS * step_rms(R, wanted)


def _better(
    model: Model, trial: ModelResult, goal: Array, tries: int
) -> tuple[ModelResult | None, int]:
    """First of the halved steps to `goal` that increases the likelihood, and the halvings."""
    now = _log_likelihood(trial.error, model.floor)
    for times in range(tries):
        # Halfway between two feasible points is feasible: the set is convex.
        theta = trial.theta + 0.5**times * (goal - trial.theta)
        try:
            after = model.evaluate(theta)
        except (EstimationError, SimulationError):
            continue
        # Likelihood and not squares of weighted errors: the weights follow the residuals, and their
        # decrease would be no progress.
        if _log_likelihood(after.error, model.floor) > now:
            return after, times
    return None, tries


def _log_likelihood(error: Array, floor: Array) -> float:
    """Log-likelihood of white noise of unknown variance per channel, up to a constant."""
    # The variance is profiled out: its estimate makes the quadratic term a constant.
    return -float(len(error) * np.log(error_noise(error, floor)).sum())


def error_noise(error: Array, floor: Array) -> Array:
    """RMS (channels,) of the errors, at least the floor; 1 for a constant channel."""
    size = np.maximum(np.sqrt((error**2).mean(axis=0)), floor)
    return np.where(size > 0, size, 1.0)


def floor_of(signal: Array) -> Array:
    """RMS (channels,) of a signal's rounding error."""
    return np.asarray(ROUNDING * np.sqrt((signal**2).mean(axis=0)))


def residual_factor(J: Array, e: Array) -> Array:
    """R (r + 1, r + 1) of [J | e], J (M, channels, r), e (M, channels)."""
    r = J.shape[-1]
    # Rows of zeros complete a short stack, so that R is always (r + 1, r + 1).
    stack = np.zeros((max(e.size, r + 1), r + 1), order="F")
    stack[: e.size, :r], stack[: e.size, r] = J.reshape(-1, r), e.ravel()
    packed, _, _, _ = lapack.dgeqrf(stack, lwork=64 * (r + 1), overwrite_a=1)
    return np.triu(packed[: r + 1])


def has_converged(
    R: Array, change: Array, beta: Array, share: float = CONVERGED, rounding: float = ROUNDING
) -> bool:
    """Return whether a step (r,) is small against the noise, or against rounding."""
    return step_rms(R, change) <= max(share, rounding * step_rms(R, beta))


def step_rms(R: Array, change: Array) -> float:
    """RMS length of a step (r,) in standard deviations of beta."""
    r = len(change)
    return float(np.linalg.norm(R[:r, :r] @ change) / np.sqrt(max(r, 1)))


def weighted_fit(W: Array, b: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Return (beta (r,), R (r + 1, r + 1), noise (rows,)) of b (N, rows) on W (N, rows, r), with
    rows divided by `sigma` (rows,), then by the RMS of the residuals of that fit."""
    for _ in range(2):
        R = residual_factor(W / sigma[:, None], b / sigma)
        beta = solve(R)
        sigma = error_noise(b - W @ beta, floor_of(b))
    return beta, R, sigma


def start_of(experiment: Experiment, simulatable: SimulatableSet) -> Array:
    """Start (p,): the prior, else least squares along the commanded motion, whose regressor has no
    measurement noise."""
    problem = experiment.problem
    if problem.prior is not None:
        return simulatable.centre
    raw, commanded = experiment.raw, _commanded_of(experiment)
    tau = rows_of(experiment, raw.tau) - experiment.known(commanded)
    beta, R, _ = weighted_fit(regressor_of(experiment, commanded), tau, np.ones(tau.shape[1]))
    return simulatable.nearest(beta, R[:-1, :-1])


def _commanded_of(experiment: Experiment) -> Trajectory:
    """Commanded motion at the recorded times; raises UnsupportedError without a controller."""
    raw = experiment.raw
    if raw.commanded is None or raw.controller is None:
        raise UnsupportedError(
            "This method simulates the closed loop, and no controller is declared: in a log, add "
            "controller = { kp = [...], kd = [...] } and q_ref, the columns of the commanded "
            "positions."
        )
    return samples_of(raw.commanded, indices_of(raw.t, raw.commanded.t))


def samples_of(motion: Trajectory, indices: Array) -> Trajectory:
    """Samples of a motion at some indices."""
    return Trajectory(
        motion.t[indices], motion.q[indices], motion.v[indices], motion.a[indices], motion.name
    )


def indices_of(t: Array, grid: Array) -> Array:
    """Indices of the times t (M,) in a grid (N,) that contains them."""
    # Half a step earlier: rounding of the times cannot select the next sample.
    return np.asarray(np.searchsorted(grid, t - 0.5 * (grid[1] - grid[0])))


def regressor_of(experiment: Experiment, motion: Trajectory) -> Array:
    """Base regressor (N, rows, r) along a motion."""
    blocks = list(experiment.regress(motion))
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def rows_of(experiment: Experiment, tau: Array) -> Array:
    """Columns of torques (N, nv) that the task measures, (N, rows)."""
    names = experiment.raw.rows
    return tau[:, [names.index(row) for row in experiment.problem.rows]]


def simulatable_start(experiment: Experiment) -> tuple[SimulatableSet, Array]:
    """Simulatable set and start (p,) of a method that simulates the closed loop."""
    _commanded_of(experiment)
    simulatable = simulatable_set(experiment.problem)
    return simulatable, start_of(experiment, simulatable)
