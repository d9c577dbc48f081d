"""What the simulated closed loop does otherwise than the robot, and how that hangs on beta."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.identification.feasibility.simulatable import SimulatableSet
from sysid_bench.identification.simulation_based.gauss_newton import (
    Candidate,
    floor_of,
    regressor_along,
)
from sysid_bench.types import Array, Experiment, Recording

NUDGE: Final = 1e-4
"""Size of a finite difference: the share of the torques that it changes."""

Signal = Callable[[Experiment, Recording], Array]
"""What is compared of a recording, (N, channels)."""


@dataclass(frozen=True, eq=False)
class OutputError:
    """A measured signal against the simulated one; slopes by finite differences of simulations."""

    experiment: Experiment
    room: SimulatableSet
    signal: Signal
    approximates = False

    @cached_property
    def measured(self) -> Array:
        """(N, channels)."""
        return self.signal(self.experiment, self.experiment.raw)

    @cached_property
    def floor(self) -> Array:
        """Rounding of the signal (channels,)."""
        return np.asarray(floor_of(self.measured))

    def evaluate(self, theta: Array) -> Candidate:
        """One simulation."""
        simulated = self.experiment.simulate(theta)
        error = self.measured - self.signal(self.experiment, simulated)
        return Candidate(theta, self.room.problem.base.K @ theta, error, simulated)

    def jacobian(self, trial: Candidate) -> Array:
        """Derivative (N, channels, r) of the simulated signal: r simulations."""
        assert trial.recording is not None
        lift = self.room.lift_of(trial.theta)
        W = regressor_along(self.experiment, trial.recording.motion)
        sizes = np.sqrt((W**2).sum(axis=(0, 1)))
        torque = np.linalg.norm(trial.recording.tau)
        columns = [
            self._difference(trial, direction, NUDGE * torque / size)
            for direction, size in zip(lift.T, sizes, strict=True)
        ]
        return np.stack(columns, axis=-1)

    def _difference(self, trial: Candidate, direction: Array, nudge: float) -> Array:
        """Derivative (N, channels) along a direction (p,), where bodies can exist."""
        nudge = min(nudge, self.room.step_limit(trial.theta, direction))
        other = self.evaluate(trial.theta + nudge * direction)
        return (trial.error - other.error) / nudge
