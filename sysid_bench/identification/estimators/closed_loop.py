"""Gauss-Newton on the simulated closed loop: output error, input error, guarded DIDIM."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.optimisers import parse_budget, simulate_many, with_budget
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


DIFFERENCES, SENSITIVITY, CORRECTED, FIRST, REGRESSOR = (
    *("differences", "sensitivity", "corrected", "first", "regressor"),
)


@dataclass(frozen=True, eq=False)
class OutputError:
    """Measured minus simulated signal, with a Jacobian of one kind.

    DIFFERENCES: by r simulations. SENSITIVITY: of the sensitivity equations, without simulations.
    CORRECTED: that plus its difference from finite differences at an iterate within NEAR standard
    deviations, which hardly depends on beta. FIRST: finite differences at the first iterate, which
    Broyden updates correct. REGRESSOR: of torques, W along the simulated motion; it leaves out how
    that motion depends on beta.
    """

    experiment: Experiment
    simulatable: SimulatableSet
    signal: Signal
    kind: str = DIFFERENCES

    @property
    def approximates(self) -> bool:
        """True where Broyden updates correct the Jacobian."""
        return self.kind not in (DIFFERENCES, CORRECTED)

    @property
    def exact(self) -> Model | None:
        """The same with the Jacobian that decides; None where it is this one."""
        decides = {SENSITIVITY: CORRECTED, FIRST: DIFFERENCES}.get(self.kind)
        return None if decides is None else replace(self, kind=decides)

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

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (N, channels, r) of the simulated signal by beta."""
        experiment, recording = self.experiment, trial.recording
        assert recording is not None
        if self.kind == REGRESSOR:
            return regressor_of(experiment, recording.motion)
        if self.kind == DIFFERENCES:
            return self._differences(trial)
        if self.kind == FIRST:
            # Kept in the instance, which is frozen: a Jacobian is not a setting.
            if "first" not in vars(self):
                vars(self)["first"] = self._differences(trial)
            return np.asarray(vars(self)["first"])
        dq, dtau = TrackingSensitivity(experiment, recording, trial.beta).jacobian()
        columns = [
            self.signal(experiment, replace(recording, q=dq[..., j], tau=dtau[..., j]))
            for j in range(len(trial.beta))
        ]
        sensitivity = np.stack(columns, axis=-1)
        if self.kind == SENSITIVITY:
            return sensitivity
        if "kept" in vars(self):
            beta, exact, correction = vars(self)["kept"]
            # RMS distance from the iterate with finite differences, in standard deviations.
            moved = exact @ (trial.beta - beta) / error_noise(trial.error, self.floor)
            if np.linalg.norm(moved) / np.sqrt(len(beta)) <= NEAR:
                return np.asarray(sensitivity + correction)
        exact = self._differences(trial)
        vars(self)["kept"] = trial.beta, exact, exact - sensitivity
        return exact

    def _differences(self, trial: ModelResult) -> Array:
        assert trial.recording is not None
        # A step of one base parameter moves theta as little as the metric allows: it stays
        # feasible.
        inverse = self.simulatable.pseudo_inverse(trial.theta)
        W = regressor_of(self.experiment, trial.recording.motion)
        # Steps of equal effect on the torques: parameters differ by orders of magnitude.
        sizes = np.sqrt((W**2).sum(axis=(0, 1)))
        torque = np.linalg.norm(trial.recording.tau)
        steps = [
            min(
                TORQUE_CHANGE * torque / effect, self.simulatable.step_limit(trial.theta, direction)
            )
            for direction, effect in zip(inverse.T, sizes, strict=True)
        ]
        thetas = [trial.theta + h * x for h, x in zip(steps, inverse.T, strict=True)]
        columns = []
        outcomes = simulate_many(self.experiment.simulate, thetas)
        for step, outcome in zip(steps, outcomes, strict=True):
            if not isinstance(outcome, Recording):
                raise outcome
            error = self.measured - self.signal(self.experiment, outcome)
            columns.append((trial.error - error) / step)
        return np.stack(columns, axis=-1)


def output_error(experiment: Experiment, simulatable: SimulatableSet, signal: Signal) -> Model:
    """Return measured minus simulated signal, first with the Jacobian of sensitivity equations, or
    with that of the start, which Broyden updates correct without simulations; then with one by
    finite differences near every iterate, which decides."""
    kind = SENSITIVITY if has_sensitivity(experiment) else FIRST
    return OutputError(experiment, simulatable, signal, kind)


SIGNALS: Final[Mapping[str, Signal]] = {
    "q": lambda _, recording: recording.q,
    "tau": lambda experiment, recording: rows_of(experiment, recording.tau),
}


@dataclass(frozen=True)
class _OutputErrorFit:
    """Fit of one signal of the simulated closed loop, within a budget."""

    compared: ClassVar[str]
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
        error = output_error(experiment, simulatable, SIGNALS[self.compared])
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

    compared: ClassVar[str] = "q"


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

    compared: ClassVar[str] = "tau"


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
        error = OutputError(experiment, simulatable, SIGNALS["tau"], REGRESSOR)
        return GaussNewton(self.iterations).run(error, simulatable, start)
