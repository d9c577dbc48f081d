"""Torque ripple: torque that rises and falls with the angle of the motor."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import PEAK_LOAD
from sysid_bench.simulation.harmonics import PeriodicLaw, periodic_law
from sysid_bench.simulation.motor_load import rigid_load
from sysid_bench.simulation.size import Size, check_size, joint_size


@dataclass(frozen=True)
class TorqueRipple:
    """Links of every hinge and slide receive (1 + x) times the motor's torque, x = sum_k a_k sin(k
    (N q + p)), k = 1, 2, 4 per motor revolution (Mattavelli, Tubiana, Zigliotto 2005).

    `first`, `second` and `fourth` are a_k: 1 to 5 % in all for motors and harmonic drives (to be
    verified). `ratio` is the gear ratio N, 50 to 160 on arms (1/m on slides), `phase` is p. Below
    10 Hz recorded arms show at most 2 %.
    """

    first: Size = field(default=0.01, metadata={"unit": "%"})
    second: Size = field(default=0.01, metadata={"unit": "%"})
    fourth: Size = field(default=0.005, metadata={"unit": "%"})
    ratio: Size = field(default=100.0, metadata={"unit": "1"})
    phase: Size = field(default=0.0, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("first", "second", "fourth")

    def __post_init__(self) -> None:
        """Raise UsageError for ripple of 25 % or more and for a negative ratio."""
        check_size("ratio of the effect 'torque-ripple'", self.ratio, above=True)
        for size in (self.first, self.second, self.fourth):
            if not (np.abs(np.asarray(size, dtype=float)) < 0.25).all():
                raise UsageError(
                    f"Size {size!r} of the effect 'torque-ripple': give less than 25 %."
                )

    def prepare(self, robot: RobotModel) -> PeriodicLaw | None:
        """Return the force law for this robot; None without ripple."""
        rows = robot.rows
        sizes = [joint_size(getattr(self, name), rows, name) for name in self.sizes]
        return periodic_law(
            robot,
            np.array([1.0, 2.0, 4.0]),
            np.array(sizes),
            (joint_size(self.ratio, rows, "ratio"), joint_size(self.phase, rows, "phase")),
            transmitted=PEAK_LOAD * rigid_load(robot),
        )
