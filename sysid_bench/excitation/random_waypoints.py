"""Random waypoints with asynchronous joints: the motion of Traversaro et al. (2015)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.excitation.design_problem import MARGIN, DesignProblem
from sysid_bench.models.robot import Joint
from sysid_bench.types import Array, Trajectory

# s(u) = 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7 on [0, 1], whose jerk is zero at both ends: peaks of s'
# and of s''.
_SEPTIC_RATE: Final = 2.1875
_SEPTIC_CHANGE: Final = 420 * 0.64 / (16 * np.sqrt(5))

_SHARES: Final = (0.6, 1.4)
"""Range of a move's random duration, relative to `move`."""


@dataclass(frozen=True)
class RandomWaypoints:
    """Joints that move between random points of their ranges, each at its own times and without
    rests.

    `joints` move (none named: all), the others stand in the middle of their range. The motion
    starts after `rest` (s); a move takes about `move` (s), or longer where the limits require it.
    """

    duration: float = field(default=20.0, metadata={"unit": "s"})
    rest: float = field(default=0.0, metadata={"unit": "s"})
    move: float = field(default=1.5, metadata={"unit": "s"})
    joints: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Raise UsageError for settings out of range."""
        if not (self.duration > self.rest >= 0 and self.move > 0):
            raise UsageError(f"{self}: required are 0 <= rest < duration and a positive move.")
        if isinstance(self.joints, str) or not all(isinstance(j, str) for j in self.joints):
            raise UsageError(f"{self}: joints must be a list of names.")

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return the motion; raises UsageError for an unknown joint."""
        t = brief.times(self.duration)
        x = np.tile(0.5 * (brief.low + brief.high), (len(t), 1))
        dx, ddx = np.zeros_like(x), np.zeros_like(x)
        for i in self._moving(brief):
            x[:, i], dx[:, i], ddx[:, i] = self._profile(brief, i, t, rng)
        return brief.trajectory(t, x, dx, ddx, "wander")

    def _moving(self, brief: DesignProblem) -> list[int]:
        """Return the indices of the profiles that move."""
        dofs = {
            dof
            for joint in self._chosen(brief)
            for dof in range(joint.vadr, joint.vadr + len(joint.dofs))
        }
        return [i for i, dof in enumerate(brief.dofs) if int(dof) in dofs]

    def _chosen(self, brief: DesignProblem) -> list[Joint]:
        """Return the joints named, or all; raises UsageError for an unknown name."""
        names = [joint.name for joint in brief.joints]
        for name in self.joints:
            if name not in names:
                raise unknown_name("joint", name, names)
        return [joint for joint in brief.joints if joint.name in (self.joints or names)]

    def _profile(
        self, brief: DesignProblem, i: int, t: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        """Return x, dx, ddx (N,) of profile i."""
        middle = 0.5 * (brief.low[i] + brief.high[i])
        reach = 0.5 * MARGIN * (brief.high[i] - brief.low[i])
        x, dx, ddx = np.full(len(t), middle), np.zeros(len(t)), np.zeros(len(t))
        start, position = self.rest, middle
        while start < self.duration:
            target = middle + reach * rng.uniform(-1.0, 1.0)
            step = target - position
            # Peaks of a move over `step` in time T: rate step / T, change step / T^2.
            shortest = max(
                _SEPTIC_RATE * abs(step) / (MARGIN * brief.v[i]),
                np.sqrt(_SEPTIC_CHANGE * abs(step) / (MARGIN * brief.a[i])),
            )
            T = max(self.move * rng.uniform(*_SHARES), shortest)
            during = (t >= start) & (t < start + T)
            u = (t[during] - start) / T
            x[during] = position + step * u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)
            dx[during] = step / T * 140 * (u * (1 - u)) ** 3
            ddx[during] = step / T**2 * 420 * (u * (1 - u)) ** 2 * (1 - 2 * u)
            start, position = start + T, target
        return x, dx, ddx
