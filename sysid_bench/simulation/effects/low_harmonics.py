"""Low harmonics: torque that is periodic in the joint's own angle, of cables and eccentric
gears."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.simulation.harmonics import PeriodicLaw, periodic_law, rotation_dofs
from sysid_bench.simulation.size import Size, joint_size


@dataclass(frozen=True)
class LowHarmonics:
    """Torque F sum_k a_k sin(k (q + p)), k = 1, 2, 3, on every hinge, with F the joint's RMS
    gravity torque (at least 0.1 % of that of the most loaded joint).

    `first`, `second` and `third` are a_k, `phase` is p. On single joints of recorded arms these
    harmonics explain 12 to 86 % of the residual, some per cent of the torque.
    """

    first: Size = field(default=0.02, metadata={"unit": "%"})
    second: Size = field(default=0.01, metadata={"unit": "%"})
    third: Size = field(default=0.01, metadata={"unit": "%"})
    phase: Size = field(default=0.0, metadata={"unit": "rad"})
    sizes: ClassVar[tuple[str, ...]] = ("first", "second", "third")

    def prepare(self, robot: RobotModel) -> PeriodicLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        rows, gravity = robot.rows, gravity_rms(robot, robot.mj)
        sizes = np.array([joint_size(getattr(self, name), rows, name) for name in self.sizes])
        return periodic_law(
            robot,
            np.array([1.0, 2.0, 3.0]),
            sizes * rotation_dofs(robot),
            (np.ones(robot.nv), joint_size(self.phase, rows, "phase")),
            force=np.maximum(gravity, 1e-3 * gravity.max()),
        )
