"""Gain and offset errors of torque or current sensing."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.sensor_chain import TorqueSignal
from sysid_bench.simulation.size import Size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class TorqueGain:
    """Relative error `gain` and constant error `offset` of each joint's torque reading.

    Torque constants of motors scatter by 2 to 5 %, and fall by 0.1 %/K as magnets warm (data
    sheets; to be verified).
    """

    gain: Size = field(default=0.03, metadata={"unit": "%"})
    offset: Size = field(default=0.0, metadata={"unit": "N m|N"})
    sizes: ClassVar[tuple[str, ...]] = ("gain", "offset")

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Gain | None":
        """Return the stage; None where both errors are zero."""
        gain = joint_size(self.gain, robot.torque_rows, "gain")
        offset = joint_size(self.offset, robot.torque_rows, "offset")
        return _Gain(gain, offset) if gain.any() or offset.any() else None


@dataclass(frozen=True, eq=False)
class _Gain:
    gain: Array
    offset: Array

    def torque_reading(self, signal: TorqueSignal, rng: np.random.Generator) -> Array:
        """Return (1 + gain) tau + offset (N, n)."""
        return np.asarray((1.0 + self.gain) * signal.tau + self.offset)
