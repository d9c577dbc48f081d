"""Gauss-Newton on the simulated closed loop: output error, input error, guarded DIDIM."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

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


@dataclass(frozen=True, eq=False)
class _SignalError(ABC):
    """Measured minus simulated signal."""

    experiment: Experiment
    simulatable: SimulatableSet
    signal: Signal
    approximates = False

    @property
    def exact(self) -> Model | None:
        """None: the Jacobian decides."""
        return None

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
        return ModelResult(theta, self.experiment.problem.base.K @ theta, error, simulated)

    @abstractmethod
    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the simulated signal by beta."""


@dataclass(frozen=True, eq=False)
class OutputError(_SignalError):
    """The error with a Jacobian by finite differences of simulations."""

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
        columns = []
        for direction, effect in zip(inverse.T, sizes, strict=True):
            limit = self.simulatable.step_limit(trial.theta, direction)
            size = min(TORQUE_CHANGE * torque / effect, limit)
            other = self.evaluate(trial.theta + size * direction)
            columns.append((trial.error - other.error) / size)
        return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class _Sensitivity(OutputError):
    """The error with the Jacobian of the sensitivity equations."""

    approximates = True

    @property
    def exact(self) -> Model | None:
        """The same, corrected by finite differences."""
        return _CorrectedSensitivity(self.experiment, self.simulatable, self.signal)

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the simulated signal, without simulations."""
        experiment, recording = self.experiment, trial.recording
        assert recording is not None
        dq, dtau = TrackingSensitivity(experiment, recording, trial.beta).jacobian()
        columns = [
            self.signal(experiment, replace(recording, q=dq[..., j], tau=dtau[..., j]))
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
        if "kept" in vars(self):
            beta, exact, correction = vars(self)["kept"]
            # RMS distance from the iterate with finite differences, in standard deviations.
            moved = exact @ (trial.beta - beta) / error_noise(trial.error, self.floor)
            if np.linalg.norm(moved) / np.sqrt(len(beta)) <= NEAR:
                return np.asarray(sensitivity + correction)
        exact = OutputError.jacobian(self, trial)
        vars(self)["kept"] = trial.beta, exact, exact - sensitivity
        return exact


@dataclass(frozen=True, eq=False)
class _FirstJacobian(OutputError):
    """The error with the Jacobian of the first iterate for all, which Broyden updates correct."""

    approximates = True

    @property
    def exact(self) -> Model | None:
        """The same, with finite differences at every iterate."""
        return OutputError(self.experiment, self.simulatable, self.signal)

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the signal that was simulated first."""
        if "first" not in vars(self):
            vars(self)["first"] = super().jacobian(trial)
        return np.asarray(vars(self)["first"])


@dataclass(frozen=True, eq=False)
class _TorqueError(_SignalError):
    """The error of torques, with the regressor along the simulated motion as Jacobian: it leaves
    out how that motion depends on beta."""

    approximates = True

    def jacobian(self, trial: ModelResult) -> Array:
        """Regressor W (N, rows, r) along the simulated motion."""
        assert trial.recording is not None
        return regressor_of(self.experiment, trial.recording.motion)


def output_error(experiment: Experiment, simulatable: SimulatableSet, signal: Signal) -> Model:
    """Return measured minus simulated signal, first with the Jacobian of sensitivity equations, or
    with that of the start, which Broyden updates correct without simulations; then with one by
    finite differences near every iterate, which decides."""
    kind = _Sensitivity if has_sensitivity(experiment) else _FirstJacobian
    return kind(experiment, simulatable, signal)


def _positions(_: Experiment, recording: Recording) -> Array:
    return recording.q


def _torques(experiment: Experiment, recording: Recording) -> Array:
    return rows_of(experiment, recording.tau)


@dataclass(frozen=True)
class _OutputErrorFit(ABC):
    """Fit of one signal of the simulated closed loop, within a budget."""

    iterations: int = 20
    budget: str | None = None

    @property
    @abstractmethod
    def signal(self) -> Signal:
        """The compared signal."""

    def __post_init__(self) -> None:
        """Raise UsageError for a budget that there is not."""
        parse_budget(self.budget)

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UnsupportedError where the recording declares no controller."""
        experiment = with_budget(experiment, self.budget)
        simulatable, start = simulatable_start(experiment)
        error = output_error(experiment, simulatable, self.signal)
        return GaussNewton(self.iterations).run(error, simulatable, start)


@dataclass(frozen=True)
class CLOE(_OutputErrorFit):
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

    @property
    def signal(self) -> Signal:
        """Positions."""
        return _positions


@dataclass(frozen=True)
class CLIE(_OutputErrorFit):
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

    @property
    def signal(self) -> Signal:
        """Torques."""
        return _torques


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
        error = _TorqueError(experiment, simulatable, _torques)
        return GaussNewton(self.iterations).run(error, simulatable, start)
