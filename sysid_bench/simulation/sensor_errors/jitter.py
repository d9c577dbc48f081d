"""Jitter of the sampling times: samples that are not taken when their stamps say."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import check_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Jitter:
    """Sampling at t + e with the stamp t; e is normal with the standard deviation `std`, and the
    same for all joints of a sample, which one clock takes.

    General-purpose operating systems have 0.1 to 1 ms (to be verified).
    """

    std: float = field(default=2e-4, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("std",)

    def __post_init__(self) -> None:
        """Raise UsageError for a negative deviation."""
        check_size("std of the sensor error 'jitter'", self.std)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Jitter | None":
        """Return the stage; None without jitter."""
        return _Jitter(self.std, len(robot.torque_rows)) if self.std else None


@dataclass(frozen=True, eq=False)
class _Jitter:
    std: float
    joints: int

    def sampling_delay(self, t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the age (K, n) of positions and torques, s: -e in each."""
        early = np.repeat(self.std * rng.normal(size=(len(t), 1)), self.joints, axis=1)
        return -early, -early
