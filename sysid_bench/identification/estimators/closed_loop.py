"""Gauss-Newton on the simulated closed loop: output error, input error, guarded DIDIM."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.optimisers import parse_budget, with_budget
from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    Model,
    ModelResult,
    error_noise,
    floor_of,
    regressor_of,
    rows_of,
    simulatable_start,
)
from sysid_bench.identification.simulation_based.tracking_sensitivity import (
    TrackingSensitivity,
    has_sensitivity,
)
from sysid_bench.types import Array, Estimate, Experiment, Recording

TORQUE_CHANGE: Final = 1e-4
"""Relative change of the torques by a finite difference."""

NEAR: Final = 1.0
"""Standard deviations of beta within which one Jacobian by finite differences serves."""

Signal = Callable[[Experiment, Recording], Array]
"""Compared signal (N, channels) of a recording."""


def output_error(experiment: Experiment, simulatable: SimulatableSet, signal: Signal) -> Model:
    """Return measured minus simulated signal, first with the Jacobian of sensitivity equations, or
    with that of the start, which Broyden updates correct without simulations; then with one by
    finite differences near every iterate, which decides."""
    exact = OutputError(experiment, simulatable, signal)
    return _Sensitivity(exact) if has_sensitivity(experiment) else _FirstJacobian(exact)


@dataclass(frozen=True, eq=False)
class OutputError:
    """Measured minus simulated signal; Jacobian by finite differences of simulations."""

    experiment: Experiment
    simulatable: SimulatableSet
    signal: Signal
    approximates = False
    exact: ClassVar[Model | None] = None

    @cached_property
    def measured(self) -> Array:
        """Measured signal (N, channels)."""
        return self.signal(self.experiment, self.experiment.raw)

    @cached_property
    def floor(self) -> Array:
        """Rounding error of the signal (channels,)."""
        return np.asarray(floor_of(self.measured))

    def evaluate(self, theta: Array) -> ModelResult:
        """Simulate the closed loop with theta (p,)."""
        simulated = self.experiment.simulate(theta)
        error = self.measured - self.signal(self.experiment, simulated)
        return ModelResult(theta, self.simulatable.problem.base.K @ theta, error, simulated)

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the simulated signal, by r simulations."""
        assert trial.recording is not None
        # A step of one base parameter moves theta as little as the metric allows: it stays
        # feasible.
        inverse = self.simulatable.pseudo_inverse(trial.theta)
        W = regressor_of(self.experiment, trial.recording.motion)
        # Steps of equal effect on the torques: parameters differ by orders of magnitude.
        sizes = np.sqrt((W**2).sum(axis=(0, 1)))
        torque = np.linalg.norm(trial.recording.tau)
        columns = [
            self._difference(trial, direction, TORQUE_CHANGE * torque / size)
            for direction, size in zip(inverse.T, sizes, strict=True)
        ]
        return np.stack(columns, axis=-1)

    def _difference(self, trial: ModelResult, direction: Array, size: float) -> Array:
        """Derivative (N, channels) along a direction (p,), with a step inside the feasible set."""
        size = min(size, self.simulatable.step_limit(trial.theta, direction))
        other = self.evaluate(trial.theta + size * direction)
        return np.asarray((trial.error - other.error) / size)


@dataclass(frozen=True, eq=False)
class _Sensitivity:
    """The same errors with the Jacobian of the sensitivity equations."""

    differences: OutputError
    approximates = True

    @property
    def exact(self) -> Model | None:
        """The same, corrected by finite differences."""
        return _CorrectedSensitivity(self.differences)

    @property
    def floor(self) -> Array:
        """Rounding error of the signal (channels,)."""
        return self.differences.floor

    def evaluate(self, theta: Array) -> ModelResult:
        """Simulate the closed loop with theta (p,)."""
        return self.differences.evaluate(theta)

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the simulated signal, without simulations."""
        experiment, recording = self.differences.experiment, trial.recording
        assert recording is not None
        dq, dtau = TrackingSensitivity(experiment, recording, trial.beta).jacobian()
        columns = [
            self.differences.signal(experiment, replace(recording, q=dq[..., j], tau=dtau[..., j]))
            for j in range(len(trial.beta))
        ]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class _CorrectedSensitivity(_Sensitivity):
    """The same plus its difference from the Jacobian by finite differences at an iterate within
    NEAR standard deviations, which hardly depends on beta."""

    approximates = False

    @property
    def exact(self) -> Model | None:
        """None: it decides."""
        return None

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the simulated signal, by r simulations where there is no
        iterate nearby with finite differences."""
        sensitivity = super().jacobian(trial)
        kept = vars(self).get("kept")
        if kept is None or self._distance(trial, kept) > NEAR:
            exact = self.differences.jacobian(trial)
            vars(self)["kept"] = trial.beta, exact, exact - sensitivity
            return exact
        return np.asarray(sensitivity + kept[2])

    def _distance(self, trial: ModelResult, kept: tuple[Array, Array, Array]) -> float:
        """RMS distance from the iterate with finite differences, in standard deviations."""
        beta, jacobian, _ = kept
        moved = jacobian @ (trial.beta - beta) / error_noise(trial.error, self.floor)
        return float(np.linalg.norm(moved) / np.sqrt(len(beta)))


@dataclass(frozen=True, eq=False)
class _FirstJacobian:
    """The same errors with the Jacobian of the first iterate for all."""

    exact: OutputError
    approximates = True

    @property
    def floor(self) -> Array:
        """Rounding error of the signal (channels,)."""
        return self.exact.floor

    def evaluate(self, theta: Array) -> ModelResult:
        """Simulate the closed loop with theta (p,)."""
        return self.exact.evaluate(theta)

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the signal that was simulated first."""
        if "first" not in vars(self):
            vars(self)["first"] = self.exact.jacobian(trial)
        return np.asarray(vars(self)["first"])


@dataclass(frozen=True)
class CLOE:
    """min sum |S^-1/2 (q - q_s(beta))|^2, q_s the simulated position of the closed loop.

    The model runs under the declared controller along the commanded motion; S is the noise variance
    per joint, from the residuals. Gauss-Newton (gauss_newton.py) with the Jacobian of sensitivity
    equations (tracking_sensitivity.py) and Broyden updates, which for the last steps finite
    differences correct, r simulations at an iterate within one standard deviation. Stops at a step
    below 0.1 standard deviations, of 20 iterations the problems of the conformance kit take 3;
    or at the end of a `budget`, "10 s" of CPU time or "500 simulations" (None: no limit), with the
    last accepted iterate. Positions under a stiff controller hardly depend on the inertias, so that
    it needs exact gains. Walter and Pronzato (1997); Janot, Gautier, Jubien, Vandanjon (2014).
    """

    iterations: int = 20
    budget: str | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for a budget that there is not."""
        parse_budget(self.budget)

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UnsupportedError where the recording declares no controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        return GaussNewton(self.iterations).run(
            output_error(experiment, simulatable, _positions), simulatable, start
        )


def _positions(experiment: Experiment, recording: Recording) -> Array:
    return recording.q


@dataclass(frozen=True)
class CLIE:
    """min sum |S^-1/2 (tau - tau_s(beta))|^2, tau_s the simulated torque of the closed loop.

    The model runs under the declared controller along the commanded motion; S is the noise variance
    per joint, from the residuals. Gauss-Newton (gauss_newton.py) with the Jacobian of sensitivity
    equations (tracking_sensitivity.py) and Broyden updates, which for the last steps finite
    differences correct, r simulations at an iterate within one standard deviation. Unlike DIDIM
    they include how the simulated motion depends on beta. Stops at a step below 0.1 standard
    deviations, of 20 iterations the problems of the conformance kit take 3; or at the end of a
    `budget`, "10 s" of CPU time or "500 simulations" (None: no limit), with the last accepted
    iterate. Assumes the controller as declared and white torque noise. Janot, Gautier, Jubien,
    Vandanjon (2014).
    """

    iterations: int = 20
    budget: str | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for a budget that there is not."""
        parse_budget(self.budget)

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UnsupportedError where the recording declares no controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        return GaussNewton(self.iterations).run(
            output_error(experiment, simulatable, _torques), simulatable, start
        )


def _torques(experiment: Experiment, recording: Recording) -> Array:
    return rows_of(experiment, recording.tau)


@dataclass(frozen=True)
class GuardedDIDIM:
    """Gauss-Newton on tau - tau_s(beta), tau_s the torque of the model under the declared
    controller along the commanded motion; the Jacobian is the regressor of the simulated motion.

    Not the published DIDIM (method `didim`; Gautier, Janot, Vandanjon 2013), from which it takes
    the Jacobian. It adds Broyden's rank-one update of the Jacobian, steps that are halved until the
    likelihood increases, and iterates within the set of physically consistent bodies: the published
    iteration has none of these and may diverge under large position noise. Gains are those
    declared. Starts from the prior, else from least squares along the commanded motion; converged
    at a step below 0.1 standard deviations, an error that noise hides, or where no step increases
    the likelihood and the last was below 0.3; at most 40 iterations (13 on the problems of the
    conformance kit). Assumes the controller as declared, white torque noise.
    """

    iterations: int = 40

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UnsupportedError where the recording declares no controller."""
        simulatable, start = simulatable_start(experiment)
        return GaussNewton(self.iterations).run(_TorqueError(experiment), simulatable, start)


@dataclass(frozen=True, eq=False)
class _TorqueError:
    """Measured minus simulated torque; the Jacobian is the regressor along the simulated motion."""

    experiment: Experiment
    approximates = True
    exact: ClassVar[Model | None] = None

    @cached_property
    def measured(self) -> Array:
        """Measured torque (N, rows)."""
        return rows_of(self.experiment, self.experiment.raw.tau)

    @cached_property
    def floor(self) -> Array:
        """Rounding error of the torques (rows,)."""
        return np.asarray(floor_of(self.measured))

    def evaluate(self, theta: Array) -> ModelResult:
        """Simulate the closed loop with theta (p,)."""
        simulated = self.experiment.simulate(theta)
        error = self.measured - rows_of(self.experiment, simulated.tau)
        return ModelResult(theta, self.experiment.problem.base.K @ theta, error, simulated)

    def jacobian(self, trial: ModelResult) -> Array:
        """Regressor W (N, rows, r) along the simulated motion."""
        assert trial.recording is not None
        return regressor_of(self.experiment, trial.recording.motion)
