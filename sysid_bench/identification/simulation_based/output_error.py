"""What the simulated closed loop does otherwise than the robot, and how that hangs on beta."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.identification.feasibility.simulatable import Possible
from sysid_bench.identification.simulation_based.gauss_newton import Trial, along, floor_of
from sysid_bench.types import Array, Experiment, Recording

NUDGE: Final = 1e-4
"""Size of a finite difference: the share of the torques that it changes."""

Signal = Callable[[Experiment, Recording], Array]
"""What is compared of a recording, (N, channels)."""


@dataclass(frozen=True, eq=False)
class OutputError:
    """A measured signal against the simulated one; slopes by finite differences of simulations."""

    experiment: Experiment
    room: Possible
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

    def attempt(self, theta: Array) -> Trial:
        """One simulation."""
        simulated = self.experiment.simulate(theta)
        error = self.measured - self.signal(self.experiment, simulated)
        return Trial(theta, self.room.problem.base.K @ theta, error, simulated)

    def slope(self, trial: Trial) -> Array:
        """Derivative (N, channels, r) of the simulated signal: r simulations."""
        assert trial.recording is not None
        lift = self.room.lift(trial.theta)
        W = along(self.experiment, trial.recording.motion)
        sizes = np.sqrt((W**2).sum(axis=(0, 1)))
        torque = np.linalg.norm(trial.recording.tau)
        columns = [
            self._difference(trial, direction, NUDGE * torque / size)
            for direction, size in zip(lift.T, sizes, strict=True)
        ]
        return np.stack(columns, axis=-1)

    def _difference(self, trial: Trial, direction: Array, nudge: float) -> Array:
        """Derivative (N, channels) along a direction (p,), where bodies can exist."""
        nudge = min(nudge, self.room.reach(trial.theta, direction))
        other = self.attempt(trial.theta + nudge * direction)
        return (trial.error - other.error) / nudge
