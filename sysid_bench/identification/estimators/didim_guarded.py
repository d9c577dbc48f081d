"""Guarded DIDIM: Gauss-Newton with the simulated regressor as Jacobian, and a line search."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    Model,
    ModelResult,
    floor_of,
    regressor_of,
    rows_of,
    simulatable_start,
)
from sysid_bench.types import Array, Estimate, Experiment


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
