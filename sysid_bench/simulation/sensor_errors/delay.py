"""Delays of the log: positions and torques that are older than their stamps."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Delay:
    """Delay `q` of each joint's position and `tau` of its torque in the log; their difference is
    the skew between the channels. The controller has neither.

    Torques of single joints of recorded arms seem to lag by 15 to 60 ms, which friction mimics in
    part; buses skew channels by 1 to 8 ms (to be verified). Delays may be fractions of a sample.
    """

    q: Size = field(default=0.0, metadata={"unit": "s"})
    tau: Size = field(default=0.002, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("q", "tau")

    def __post_init__(self) -> None:
        """Raise UsageError for a negative delay."""
        check_size("q of the sensor error 'delay'", self.q)
        check_size("tau of the sensor error 'delay'", self.tau)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Late | None":
        """Return the stage; None where all delays are zero."""
        q = joint_size(self.q, robot.torque_rows, "q")
        tau = joint_size(self.tau, robot.torque_rows, "tau")
        return _Late(q, tau) if q.any() or tau.any() else None


@dataclass(frozen=True, eq=False)
class _Late:
    q: Array
    tau: Array

    def sampling_delay(self, t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the delays (K, n) of positions and torques, s."""
        return np.tile(self.q, (len(t), 1)), np.tile(self.tau, (len(t), 1))
