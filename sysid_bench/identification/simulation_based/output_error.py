"""Output error of the simulated closed loop, and its derivative by beta."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.simulation_based.gauss_newton import (
    Model,
    ModelResult,
    error_noise,
    floor_of,
    regressor_of,
)
from sysid_bench.identification.simulation_based.tracking_sensitivity import (
    TrackingSensitivity,
    has_sensitivity,
)
from sysid_bench.types import Array, Experiment, Recording

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
