"""DIDIM and IDIM-IV as published: simulate the closed loop, fit linearly, repeat.

With the declared gains the closed-loop poles of a simulation move with the inertia of its
parameters. Gautier, Janot and Vandanjon (2013) multiply the gains of each joint by the inertia of
the simulated robot over that of the actual one, so that the poles stay those of the actual robot,
and the simulated motion near the measured one, for any parameters."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
from scipy.signal import decimate

from sysid_bench.errors import EstimationError, SimulationError, UsageError, unknown_name
from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.linear.least_squares import (
    covariance,
    dense_rows,
    scaled_fit,
    stacked_factor,
    torque_rms,
)
from sysid_bench.identification.optimisers import BudgetError, parse_budget, with_budget
from sysid_bench.identification.simulation_based.forward_model import unit_acceleration
from sysid_bench.identification.simulation_based.gauss_newton import (
    error_noise,
    floor_of,
    indices_of,
    regressor_of,
    residual_factor,
    rows_of,
    samples_of,
    simulatable_start,
    weighted_fit,
)
from sysid_bench.types import Array, Estimate, Experiment, Problem, Recording

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

    def estimate(self, count: int, converged: bool, stop: str) -> Estimate:
        """The estimate after `count` iterations."""
        words: dict[str, Any] = {"converged": converged, "iterations": count, "stop": stop}
        return Estimate(self.beta, covariance=self.covariance, **words)


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
        problem = self.simulatable.problem
        theta, before, stop = start, None, f"the limit of {self.iterations} iterations"
        count = 0
        while count < self.iterations:
            try:
                found = self.fit(self.simulate(theta))
            except BudgetError as spent:
                if before is None:  # the start is all that there is
                    beta = problem.base.K @ start
                    return Estimate(beta, converged=False, iterations=0, stop=str(spent))
                stop = str(spent)
                break
            except (EstimationError, SimulationError) as error:
                # Neither the start nor the first iterate leads anywhere: that is a failure.
                if before is None or count == 1:
                    raise
                stop = f"no further iterate: {error}"
                break
            count += 1
            if before is not None and self._is_met(found, before):
                change = f"change by at most {100 * self.tolerance:g} %"
                stop = f"residual norm and significant parameters {change}"
                return found.estimate(count, True, stop)
            # Bodies with this beta, or with the nearest one that bodies have.
            exact = self.simulatable.with_base(theta, found.beta)
            nearest = self.simulatable.nearest
            theta = exact if exact is not theta else nearest(found.beta, found.R)
            before = found
        assert before is not None
        check_estimate(problem, before.beta, problem.base.K @ start)
        return before.estimate(count, False, stop)

    def _is_met(self, fit: LinearFit, before: LinearFit) -> bool:
        # Residuals at rounding and parameters of no significance change by chance.
        norm, norm_before = (max(one.residual, SAME) for one in (fit, before))
        if abs(norm - norm_before) > self.tolerance * norm_before:
            return False
        counted = np.sqrt(np.diag(fit.covariance)) <= SIGNIFICANT * np.abs(fit.beta)
        change = np.abs(fit.beta - before.beta)
        return bool((change <= self.tolerance * np.abs(before.beta))[counted].all())


def check_estimate(problem: Problem, beta: Array, start: Array) -> None:
    """Raise EstimationError for an iterate beta (r,) that is not finite, or that explains the
    measured torques worse than both the start (r,) and no model at all."""
    rms = torque_rms(problem)
    # Rows over their RMS torque: the strongest joint alone must not acquit an iterate.
    R = stacked_factor(problem, (1.0 / np.where(rms > 0, rms, 1.0)).tolist())
    errors = [np.linalg.norm(R @ np.append(one, -1.0)) for one in (beta, start, 0.0 * start)]
    if not np.isfinite(errors[0]) or errors[0] > max(errors[1:]):
        raise EstimationError(
            "The method diverges: its last iterate explains the torques worse than its start and "
            "than no model at all. The noise is too large, or the model does not fit the data."
        )


GAINS: Final = ("updated", "kept")
PIPELINE, RAW = "pipeline", "raw"
ROWS: Final = (RAW, PIPELINE)

POSTURES: Final = 20
"""Postures of the motion over which the inertia of each joint is averaged."""


def controlled_simulation(experiment: Experiment, actual: Array) -> Callable[[Array], Recording]:
    """Return the simulation of theta (p,) with the declared gains times the joint inertias of theta
    over those of `actual` (r,), the base parameters that the gains were made for. Gains of coupled
    joints, and of tasks that measure some of the torques, are kept."""
    raw, declared = experiment.raw, experiment.raw.controller
    assert declared is not None
    if raw.q.shape[1] != len(raw.rows) or experiment.problem.rows != raw.rows:
        return experiment.simulate
    real = joint_inertia(experiment, actual)

    def simulate(theta: Array) -> Recording:
        now = joint_inertia(experiment, experiment.problem.base.K @ theta)
        # Noise may make an inertia negative, for which no gain gives the poles.
        known = (now > 0) & (real > 0)
        ratio = np.divide(now, real, out=np.ones_like(now), where=known)
        return experiment.simulate(
            theta, replace(declared, kp=declared.kp * ratio, kd=declared.kd * ratio)
        )

    return simulate


def joint_inertia(experiment: Experiment, beta: Array) -> Array:
    """Diagonal (n,) of the mass matrix of base parameters (r,), mean over the recorded motion."""
    q = experiment.raw.q
    q = q[np.linspace(0, len(q) - 1, min(POSTURES, len(q))).astype(int)]
    n = q.shape[1]
    # Inverse dynamics at rest, with and without a unit acceleration of each joint.
    motion = unit_acceleration(q, np.zeros_like(q))
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

    `rows` "raw" (the default) are those of the paper, all samples. "pipeline" are the rows that
    linear methods fit: W along the simulated motion is filtered, decimated and left out at
    standstill as the rows of the measured motion are. At standstill friction is between its limits,
    and sign(v) of the model at one of them.

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
    rows: str = RAW

    def __post_init__(self) -> None:
        """Raise UsageError for unknown gains or rows, for a decimation or iterations below 1, and
        for a budget that there is not."""
        parse_budget(self.budget)
        if self.rows not in ROWS:
            raise unknown_name("rows", self.rows, ROWS)
        if self.rows == PIPELINE and self.decimation != 1:
            raise UsageError("The pipeline decimates its rows: leave out decimation, or rows.")
        if self.gains not in GAINS:
            raise unknown_name("gains", self.gains, GAINS)
        if min(self.decimation, self.iterations) < 1:
            raise UsageError("decimation and iterations are whole numbers of 1 or more.")

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where the first iterate cannot be
        simulated or the iteration diverges, UnsupportedError where the recording declares no
        controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        actual, _, _ = scaled_fit(experiment.problem)
        updated = self.gains == "updated"
        simulate = controlled_simulation(experiment, actual) if updated else experiment.simulate

        def fit(simulated: Recording) -> LinearFit:
            W, b = self._rows(experiment, simulated)
            # The stop rule compares residuals of two iterations, and needs weights that stay
            # between them: those of the torques, not of the residuals.
            size = error_noise(b, floor_of(b))
            beta, _, sigma = weighted_fit(W, b, size)
            rest = b - W @ beta
            R = residual_factor(W / sigma[:, None], rest / sigma)
            residual = float(np.linalg.norm(rest / size) / np.linalg.norm(b / size))
            return LinearFit(beta, covariance(R), R[:-1, :-1], residual)

        published = PublishedFit(simulatable, simulate, fit, self.tolerance, self.iterations)
        return published.run(start)

    def _rows(self, experiment: Experiment, simulated: Recording) -> tuple[Array, Array]:
        """W (M, rows, r) along the simulated motion and b (M, rows) of the measured torque."""
        if self.rows == PIPELINE:
            at = indices_of(experiment.recording.t, simulated.t)
            motion, tau = samples_of(simulated.motion, at), experiment.recording.tau
            W, b = regressor_of(experiment, motion), rows_of(experiment, tau)
            return experiment.filter_rows(W), experiment.filter_rows(b - experiment.known(motion))
        motion = simulated.motion
        W, b = regressor_of(experiment, motion), rows_of(experiment, experiment.raw.tau)
        b = b - experiment.known(motion)
        if self.decimation == 1:
            return W, b
        # Zero-phase: W and tau stay in step.
        W, b = (np.asarray(decimate(x, self.decimation, axis=0)) for x in (W, b))
        return W, b


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
        W, b = dense_rows(experiment.problem)

        def fit(simulated: Recording) -> LinearFit:
            # The simulated motion at the samples of the filtered recording, filtered alike.
            same = indices_of(experiment.recording.t, simulated.t)
            Z = regressor_of(experiment, samples_of(simulated.motion, same))
            Z = experiment.filter_rows(Z)
            size = sigma = error_noise(b, floor_of(b))
            for _ in range(2):  # the second with the residual variance of the first
                beta, R, Q_W = _solution(Z, W, b, sigma)
                rest = b - W @ beta
                sigma = error_noise(rest, floor_of(b))
            # With whitened Z = Q R the factor R cancels: beta = (Q'W)^-1 Q'b, with this root of its
            # covariance.
            inverse = np.linalg.inv(Q_W)
            residual = float(np.linalg.norm(rest / size) / np.linalg.norm(b / size))
            return LinearFit(beta, inverse @ inverse.T, R, residual)

        simulate = experiment.simulate
        published = PublishedFit(simulatable, simulate, fit, self.tolerance, self.iterations)
        return published.run(start)


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
