"""Point-to-point moves with rests, as in production: validation unlike Fourier training."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import MARGIN, DesignProblem, is_count
from sysid_bench.types import Array, Trajectory

# Peaks of the quintic s(u) = 10 u^3 - 15 u^4 + 6 u^5 on [0, 1]: of s' and of s''.
_QUINTIC_RATE = 1.875
_QUINTIC_CHANGE = 10 / np.sqrt(3)


@dataclass(frozen=True)
class PointToPoint:
    """Synchronous moves between random postures with rests, as fast as the slowest joint allows, on
    the quintic profile s(u) = 10 u^3 - 15 u^4 + 6 u^5."""

    moves: int = 6
    rest: float = field(default=0.2, metadata={"unit": "s"})

    def __post_init__(self) -> None:
        """Raise UsageError for settings out of range."""
        if not (is_count(self.moves) and self.rest >= 0):
            raise UsageError(f"{self}: required are moves >= 1 and rest >= 0.")

    @property
    def share(self) -> float:
        """Share of the limits of velocity and acceleration that a move uses."""
        return MARGIN

    @property
    def name(self) -> str:
        """Name of its trajectories."""
        return "ptp"

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return a motion through `moves` random postures from rest to rest."""
        margin = 0.5 * (1 - MARGIN) * (brief.high - brief.low)
        points = rng.uniform(brief.low + margin, brief.high - margin, (self.moves + 1, brief.nv))
        steps = np.diff(points, axis=0)
        durations = _durations(steps, brief, self.share)
        starts = np.concatenate([[0.0], np.cumsum(durations + self.rest)])
        # Two samples more, so that the grid reaches the end of the last move even without a rest.
        t = brief.times(starts[-1] + 2.0 / brief.rate)
        move = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, self.moves - 1)
        u = np.minimum((t - starts[move]) / durations[move], 1.0)[:, None]
        step, T = steps[move], durations[move][:, None]
        x = points[move] + step * u**3 * (10 - 15 * u + 6 * u**2)
        dx = step / T * 30 * u**2 * (1 - u) ** 2
        ddx = step / T**2 * 60 * u * (1 - u) * (1 - 2 * u)
        return brief.trajectory(t, x, dx, ddx, self.name)


@dataclass(frozen=True)
class Static(PointToPoint):
    """Static postures with slow moves between them: gravity and spring parameters alone are
    excited."""

    moves: int = 12
    rest: float = field(default=2.0, metadata={"unit": "s"})

    @property
    def share(self) -> float:
        """Share at which gravity makes nearly all of the torque."""
        return 0.25

    @property
    def name(self) -> str:
        """Name of its trajectories."""
        return "static"


def _durations(steps: Array, brief: DesignProblem, share: float) -> Array:
    """Return the duration (n,) in s of moves over steps (n, nv)."""
    by_velocity = (_QUINTIC_RATE * np.abs(steps) / (share * brief.v)).max(axis=1)
    by_acceleration = np.sqrt(_QUINTIC_CHANGE * np.abs(steps) / (share * brief.a)).max(axis=1)
    return np.asarray(np.maximum(by_velocity, by_acceleration))
