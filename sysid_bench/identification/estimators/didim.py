"""DIDIM: the measured torque on the regressor of the simulated closed loop."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_bench.identification.simulation_based.gauss_newton import (
    Candidate,
    GaussNewton,
    floor_of,
    regressor_along,
    requires_controller,
    rows_of,
)
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class DIDIM:
    """Direct and inverse dynamic identification models (Gautier, Janot, Vandanjon 2013).

    Gauss-Newton on tau - tau_s(beta), tau_s the torque of the model under the declared controller
    along the commanded motion; the derivative is the regressor of the simulated motion, since a
    good controller moves the robot alike whatever it weighs. Neither position noise nor
    differentiation enter; torque noise is white, with its own size for each joint. Assumes the
    controller as declared. Starts from the prior, else from least squares along the commanded
    motion.
    """

    iterations: int = 40

    def fit(self, experiment: Experiment) -> Estimate:
        """The estimate; raises EstimationError where the iteration does not settle."""
        room, start = requires_controller(experiment)
        return GaussNewton(self.iterations).run(Torques(experiment), room, start)


@dataclass(frozen=True, eq=False)
class Torques:
    """Measured against simulated torque; its slope is the regressor along the simulation."""

    experiment: Experiment
    approximates = True

    @cached_property
    def measured(self) -> Array:
        """(N, rows)."""
        return rows_of(self.experiment, self.experiment.raw.tau)

    @cached_property
    def floor(self) -> Array:
        """Rounding of the torques (rows,)."""
        return np.asarray(floor_of(self.measured))

    def evaluate(self, theta: Array) -> Candidate:
        """One simulation."""
        simulated = self.experiment.simulate(theta)
        error = self.measured - rows_of(self.experiment, simulated.tau)
        return Candidate(theta, self.experiment.problem.base.K @ theta, error, simulated)

    def jacobian(self, trial: Candidate) -> Array:
        """W (N, rows, r) along the simulated motion."""
        assert trial.recording is not None
        return regressor_along(self.experiment, trial.recording.motion)
