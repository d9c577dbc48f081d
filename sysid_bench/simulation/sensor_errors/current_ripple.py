"""Current ripple: motor current that varies with the motor's angle at equal torque."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.sensor_chain import TorqueSignal
from sysid_bench.simulation.size import Size, joint_size
from sysid_bench.types import Array

HARMONICS = np.array([1.0, 2.0, 4.0])
"""Periods per revolution of the motor: offset of one phase, unequal phases, cogging."""


@dataclass(frozen=True)
class CurrentRipple:
    """Reading tau (1 + sum_k a_k sin(k N q + p_k)) of each joint's torque with k = 1, 2, 4, the
    gear ratio `ratio` (N) and phases p_k drawn per robot.

    `once`, `twice` and `four_times` are the amplitudes a_k: 1 to 5 % (to be verified). Residuals of
    six recorded arms below 10 Hz hold at most 2 % of fine ripple: fast joints show it least.
    """

    once: Size = field(default=0.01, metadata={"unit": "%"})
    twice: Size = field(default=0.005, metadata={"unit": "%"})
    four_times: Size = field(default=0.005, metadata={"unit": "%"})
    ratio: Size = field(default=100.0, metadata={"unit": "1"})
    sizes: ClassVar[tuple[str, ...]] = ("once", "twice", "four_times")

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Ripple | None":
        """Return the stage; None where all amplitudes are zero."""
        rows = robot.torque_rows
        phase = rng.uniform(0.0, 2.0 * np.pi, size=(len(HARMONICS), len(rows)))
        sizes = {"once": self.once, "twice": self.twice, "four_times": self.four_times}
        share = np.array([joint_size(size, rows, name) for name, size in sizes.items()])
        ratio = joint_size(self.ratio, rows, "ratio")
        return _Ripple(share, HARMONICS[:, None] * ratio, phase) if share.any() else None


@dataclass(frozen=True, eq=False)
class _Ripple:
    """Amplitudes, periods per radian (times 2 pi) and phases, (3, n) each."""

    share: Array
    cycles: Array
    phase: Array

    def torque_reading(self, signal: TorqueSignal, rng: np.random.Generator) -> Array:
        """Return the torque (N, n) with its ripple."""
        waves = self.share * np.sin(self.cycles * signal.q[:, None] + self.phase)
        return np.asarray(signal.tau * (1.0 + waves.sum(axis=1)))
