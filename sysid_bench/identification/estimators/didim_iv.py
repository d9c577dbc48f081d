"""DIDIM and IDIM-IV as published: simulate the closed loop, fit linearly, repeat.

With the declared gains the closed-loop poles of a simulation move with the inertia of its
parameters. Gautier, Janot and Vandanjon (2013) multiply the gains of each joint by the inertia of
the simulated robot over that of the actual one, so that the poles stay those of the actual robot,
and the simulated motion near the measured one, for any parameters."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from scipy.signal import decimate

from sysid_bench.errors import EstimationError, SimulationError, UsageError, unknown_name
from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.linear.least_squares import (
    scaled_fit,
    solve,
    stacked_factor,
    torque_rms,
)
from sysid_bench.identification.optimisers import BudgetError, parse_budget, with_budget
from sysid_bench.identification.simulation_based.gauss_newton import (
    covariance,
    error_noise,
    floor_of,
    indices_of,
    regressor_of,
    residual_factor,
    rows_of,
    samples_of,
    simulatable_start,
)
from sysid_bench.types import (
    Array,
    Controller,
    Estimate,
    Experiment,
    Problem,
    Recording,
    Trajectory,
)

SIGNIFICANT: Final = 0.1
"""Largest relative standard deviation of a parameter whose change counts: that of an essential
parameter (Pham and Gautier 1991). A parameter that is zero has no relative change."""

SAME: Final = 1e-9
"""Residual, relative to the torque, below which it is rounding and its change does not count."""


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Linear fit of one iteration: beta and its covariance; R (r, r) of the whitened regressor; the
    norm of the residual relative to that of the torque, rows divided by their RMS."""

    beta: Array  # (r,)
    covariance: Array  # (r, r)
    R: Array
    residual: float


@dataclass(frozen=True, eq=False)
class PublishedFit:
    """beta_(k+1) = fit(simulate(theta_k)), theta_k the physically consistent parameters nearest to
    beta_k.

    Converged where the residual norm and every significant parameter change by at most `tolerance`,
    relative (Gautier, Janot, Vandanjon 2013; Janot, Vandanjon, Gautier 2014). Else the estimate is
    the last iterate: that of the last iteration, or the last one that could be simulated.
    """

    simulatable: SimulatableSet
    simulate: Callable[[Array], Recording]
    fit: Callable[[Recording], LinearFit]
    tolerance: float
    iterations: int

    def run(self, start: Array) -> Estimate:
        """Return the estimate from a start (p,).

        Raises EstimationError where the first iterate cannot be simulated, or where the last one is
        not usable (`check_estimate`).
        """
        theta, before = start, None
        for count in range(1, self.iterations + 1):
            try:
                found = self.fit(self.simulate(theta))
            except BudgetError as spent:
                return self._at_end_of_budget(before, count - 1, str(spent), start)
            except (EstimationError, SimulationError) as error:
                if before is None or count == 2:
                    raise
                return self._unconverged(before, count - 1, f"no further iterate: {error}", start)
            if before is not None and self._is_met(found, before):
                return _estimate(found, count, True, self._reason)
            theta, before = self._simulatable(theta, found), found
        stop = f"the limit of {self.iterations} iterations"
        return self._unconverged(found, self.iterations, stop, start)

    def _at_end_of_budget(
        self, before: LinearFit | None, count: int, stop: str, start: Array
    ) -> Estimate:
        """The last iterate; the start where there is none."""
        if before is not None:
            return self._unconverged(before, count, stop, start)
        beta = self.simulatable.problem.base.K @ start
        return Estimate(beta, converged=False, iterations=0, stop=stop)

    @property
    def _reason(self) -> str:
        share = f"{100 * self.tolerance:g} %"
        return f"residual norm and significant parameters change by at most {share}"

    def _is_met(self, fit: LinearFit, before: LinearFit) -> bool:
        norm, norm_before = (max(one.residual, SAME) for one in (fit, before))
        if abs(norm - norm_before) > self.tolerance * norm_before:
            return False
        counted = np.sqrt(np.diag(fit.covariance)) <= SIGNIFICANT * np.abs(fit.beta)
        change = np.abs(fit.beta - before.beta)
        return bool((change <= self.tolerance * np.abs(before.beta))[counted].all())

    def _simulatable(self, theta: Array, found: LinearFit) -> Array:
        """Physically consistent parameters (p,) with the beta of a fit, or nearest to it."""
        exact = self.simulatable.with_base(theta, found.beta)
        return exact if exact is not theta else self.simulatable.nearest(found.beta, found.R)

    def _unconverged(self, fit: LinearFit, count: int, stop: str, start: Array) -> Estimate:
        problem = self.simulatable.problem
        check_estimate(problem, fit.beta, problem.base.K @ start)
        return _estimate(fit, count, False, stop)


def _estimate(fit: LinearFit, count: int, converged: bool, stop: str) -> Estimate:
    return Estimate(
        fit.beta, covariance=fit.covariance, converged=converged, iterations=count, stop=stop
    )


def check_estimate(problem: Problem, beta: Array, start: Array) -> None:
    """Raise EstimationError for an iterate beta (r,) that is not finite, or that explains the
    measured torques worse than both the start (r,) and no model at all."""
    rms = torque_rms(problem)
    R = stacked_factor(problem, (1.0 / np.where(rms > 0, rms, 1.0)).tolist())
    errors = [np.linalg.norm(R @ np.append(one, -1.0)) for one in (beta, start, 0.0 * start)]
    if not np.isfinite(errors[0]) or errors[0] > max(errors[1:]):
        raise EstimationError(
            "The method diverges: its last iterate explains the torques worse than its start and "
            "than no model at all. The noise is too large, or the model does not fit the data."
        )


GAINS: Final = ("updated", "kept")

POSTURES: Final = 20
"""Postures of the motion over which the inertia of each joint is averaged."""


@dataclass(frozen=True, eq=False)
class _ControlledModel:
    """Simulation of an experiment whose gains are those of the declared controller times `inertia`
    (rows,) of the simulated parameters over `actual`; None: gains as declared."""

    experiment: Experiment
    actual: Array | None

    def simulate(self, theta: Array) -> Recording:
        """Simulate the closed loop with theta (p,)."""
        if self.actual is None:
            return self.experiment.simulate(theta)
        now = joint_inertia(self.experiment, self.experiment.problem.base.K @ theta)
        return self.experiment.simulate(theta, self._controller(now))

    def _controller(self, now: Array) -> Controller:
        """The declared controller with the poles that it has on the actual robot."""
        declared, actual = self.experiment.raw.controller, self.actual
        assert declared is not None
        assert actual is not None
        # Noise may make an inertia negative, for which no gain gives the poles.
        known = (now > 0) & (actual > 0)
        ratio = np.divide(now, actual, out=np.ones_like(now), where=known)
        return replace(declared, kp=declared.kp * ratio, kd=declared.kd * ratio)


def check_controller(gains: str) -> None:
    """Raise UsageError for a word that is not in GAINS."""
    if gains not in GAINS:
        raise unknown_name("gains", gains, GAINS)


def controller_model(experiment: Experiment, gains: str, actual: Array) -> _ControlledModel:
    """Return the simulation with gains "updated" or "kept"; `actual` (r,): base parameters whose
    inertia the declared gains act on. Gains of coupled joints, and of tasks that measure some of
    the torques, are kept. Raises UsageError for another word."""
    check_controller(gains)
    raw = experiment.raw
    alone = raw.q.shape[1] == len(raw.rows) and experiment.problem.rows == raw.rows
    if gains == "kept" or not alone:
        return _ControlledModel(experiment, None)
    return _ControlledModel(experiment, joint_inertia(experiment, actual))


def joint_inertia(experiment: Experiment, beta: Array) -> Array:
    """Diagonal (n,) of the mass matrix of base parameters (r,), mean over the recorded motion."""
    q = experiment.raw.q
    q = q[np.linspace(0, len(q) - 1, min(POSTURES, len(q))).astype(int)]
    n = q.shape[1]
    # Inverse dynamics at rest, with and without a unit acceleration of each joint.
    a = np.tile(np.concatenate([np.zeros((1, n)), np.eye(n)]), (len(q), 1))
    motion = Trajectory(np.zeros(len(a)), np.repeat(q, n + 1, axis=0), np.zeros_like(a), a)
    tau = regressor_of(experiment, motion) @ beta + experiment.known(motion)
    tau = tau.reshape(len(q), n + 1, n)
    return np.asarray((tau[:, 1:] - tau[:, :1]).diagonal(axis1=1, axis2=2).mean(axis=0))


@dataclass(frozen=True)
class DIDIM:
    """Direct and inverse dynamic identification models (Gautier, Janot, Vandanjon 2013).

    beta_(k+1) = argmin |S^-1/2 (tau - W(q_s, v_s, a_s) beta)|^2, W the regressor along the motion
    that the model simulates with beta_k under the same controller and commanded motion, S the
    residual variance per joint. tau is the raw measured torque; `decimation` > 1 filters and
    decimates tau and W alike (parallel decimation). Neither the measured motion nor its derivatives
    enter.

    `gains` "updated" (the default, as published) multiplies the controller's gains by the joint
    inertias of the simulated parameters over those of the actual robot, so that the closed-loop
    poles stay; "kept" takes them as declared. Starts from the prior, else from least squares along
    the commanded motion. Stops where the residual norm and the significant parameters change by at
    most `tolerance` = 2.5 %, or after 10 iterations, as published.

    Deviations: the simulator needs physically consistent bodies, so that the nearest to beta_k are
    simulated; beta itself is never constrained. The published change of the parameters is over
    essential ones, here those with a relative standard deviation below 10 %. The actual inertias,
    which the paper takes from the design of the controller, are those of least squares on the
    measured motion. Where beta_k cannot be simulated, the previous iterate is the estimate; at the
    end of a `budget`, "10 s" of CPU time or "5 simulations" (None: no limit), the last one.
    """

    bias: ClassVar[str] = "ten iterations leave a part of the start, even with exact data"
    gains: str = "updated"
    decimation: int = 1
    tolerance: float = 0.025
    iterations: int = 10
    budget: str | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for unknown gains, for a decimation or iterations below 1, and for a
        budget that there is not."""
        parse_budget(self.budget)
        check_controller(self.gains)
        if min(self.decimation, self.iterations) < 1:
            raise UsageError("decimation and iterations are whole numbers of 1 or more.")

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the first iterate cannot be
        simulated or the iteration diverges, UnsupportedError where the recording declares no
        controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        actual, _, _ = scaled_fit(experiment.problem)
        model = controller_model(experiment, self.gains, actual)
        fit = _Fit(experiment, self.decimation)
        return PublishedFit(simulatable, model.simulate, fit, self.tolerance, self.iterations).run(
            start
        )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Weighted least squares of the measured torque on the regressor of a simulated motion."""

    experiment: Experiment
    decimation: int

    def __call__(self, simulated: Recording) -> LinearFit:
        experiment, motion = self.experiment, simulated.motion
        W = self._decimated(regressor_of(experiment, motion))
        tau = rows_of(experiment, experiment.raw.tau)
        b = self._decimated(tau - experiment.known(motion))
        size = error_noise(b, floor_of(b))
        sigma = size
        for _ in range(2):  # the second with the residual variance of the first
            R = residual_factor(W / sigma[:, None], b / sigma)
            beta = solve(R)
            rest = b - W @ beta
            sigma = error_noise(rest, floor_of(b))
        R = residual_factor(W / sigma[:, None], rest / sigma)
        residual = float(np.linalg.norm(rest / size) / np.linalg.norm(b / size))
        return LinearFit(beta, covariance(R), R[:-1, :-1], residual)

    def _decimated(self, x: Array) -> Array:
        """Values x (N, ...) through a zero-phase low-pass filter, every `decimation`-th."""
        return x if self.decimation == 1 else np.asarray(decimate(x, self.decimation, axis=0))


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
        fit = _Fit_iv(experiment, *_measured(experiment))
        return PublishedFit(
            simulatable, experiment.simulate, fit, self.tolerance, self.iterations
        ).run(start)


@dataclass(frozen=True, eq=False)
class _Fit_iv:
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
