"""Drift of torque sensing: linear in time, and as a random walk."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.sensor_chain import TorqueSignal
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class TorqueDrift:
    """Drift `slope` (per second) of each joint's torque reading from the start of a recording, and
    a random walk with the standard deviation `walk` after one second.

    Strain-gauge torque sensors drift by 0.2 to 1 % of their range per hour (data sheets; to be
    verified): 100 N m sensors by 6e-5 to 3e-4 N m/s.
    """

    slope: Size = field(default=1e-4, metadata={"unit": "N m|N"})  # per second
    walk: Size = field(default=0.0, metadata={"unit": "N m|N"})  # per square root of a second
    sizes: ClassVar[tuple[str, ...]] = ("slope", "walk")

    def __post_init__(self) -> None:
        """Raise UsageError for a negative deviation."""
        check_size("walk of the sensor error 'torque-drift'", self.walk)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Drift | None":
        """Return the stage; None where both drifts are zero."""
        slope = joint_size(self.slope, robot.torque_rows, "slope")
        walk = joint_size(self.walk, robot.torque_rows, "walk")
        return _Drift(slope, walk) if slope.any() or walk.any() else None


@dataclass(frozen=True, eq=False)
class _Drift:
    slope: Array
    walk: Array

    def torque_reading(self, signal: TorqueSignal, rng: np.random.Generator) -> Array:
        """Return tau + slope t + walk w(t) (N, n), w a Wiener process."""
        steps = np.diff(signal.t, prepend=signal.t[:1])[:, None]
        wiener = np.cumsum(np.sqrt(steps) * rng.normal(size=signal.tau.shape), axis=0)
        since = (signal.t - signal.t[0])[:, None]
        return np.asarray(signal.tau + self.slope * since + self.walk * wiener)
