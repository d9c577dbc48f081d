"""Encoder eccentricity: position errors that repeat with each revolution."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import Size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Eccentricity:
    """Error `amplitude` (sin(m q + p) - sin(p)) of each encoder, which the controller sees, too.

    m = `per_turn` are periods per revolution of the joint; phases p are drawn per robot.

    An encoder disc off its axis by e at the radius r errs by e / r once per revolution: 10 um at
    30 mm give 0.3 mrad (geometry; e to be verified). On the motor side `per_turn` is the gear
    ratio, and the error is divided by it. Slides repeat every 2 pi m / `per_turn`.
    """

    amplitude: Size = field(default=3e-4, metadata={"unit": "rad|m"})
    per_turn: Size = field(default=1.0, metadata={"unit": "1"})
    sizes: ClassVar[tuple[str, ...]] = ("amplitude",)

    def prepare(self, robot: RobotModel, rng: np.random.Generator) -> "_Eccentric | None":
        """Return the stage; None where the amplitude is zero. Balls and free joints have none."""
        rows = robot.torque_rows
        phase = rng.uniform(0.0, 2.0 * np.pi, size=len(rows))
        amplitude = joint_size(self.amplitude, rows, "amplitude")
        amplitude[~np.isin(robot.torque_dofs, robot.scalar_dofs)] = 0.0
        turns = joint_size(self.per_turn, rows, "per_turn")
        return _Eccentric(amplitude, turns, phase) if amplitude.any() else None


@dataclass(frozen=True, eq=False)
class _Eccentric:
    amplitude: Array
    per_turn: Array
    phase: Array

    def encoder_error(self, q: Array) -> Array:
        """Return the error (N, n) at positions q (N, n); zero at the reference, where encoders are
        set."""
        wave = np.sin(self.per_turn * q + self.phase) - np.sin(self.phase)
        return np.asarray(self.amplitude * wave)
