"""Elastic joints: rotors behind springs, with backlash, and encoders on either side."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UnsupportedError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.simulation.motor_load import mass_matrix
from sysid_bench.simulation.transmission import Transmission
from sysid_bench.types import Array


@dataclass(frozen=True)
class ElasticJoints:
    """Elastic transmission of every motor (Spong 1987), see `transmission.py`.

    `stiffness` (N m/rad, N/m) is one number or one per motor; without it K is the joint's
    typical load, at least 1 % of that of the most loaded joint, over `windup`: transmissions of
    arms have 5e3 to 5e4 N m/rad and wind up by 0.3 to 2 mrad. The typical load is the RMS gravity
    torque over random postures, and the torque of half the acceleration limit. `damping`
    is D over K (s). `gap` is half the backlash; published values are 0.1 to 1 mrad. The rotors have
    the armature of the robot; `encoders` are on the "motor" or the "link".
    """

    stiffness: float | Sequence[float] | None = None
    windup: float = field(default=1e-3, metadata={"unit": "rad|m"})
    damping: float = field(default=1e-4, metadata={"unit": "s"})
    gap: float = field(default=0.0, metadata={"unit": "rad|m"})
    encoders: str = "motor"
    vanishes_at_rest: ClassVar[bool] = True

    def prepare(self, robot: RobotModel) -> Transmission | None:
        """Return the transmission; None for rigid ones, of no windup and gap.

        Raises UnsupportedError for coupled joints.
        """
        if self.stiffness is None and self.windup == 0:
            return None
        if robot.coupling is not None:
            raise UnsupportedError(
                f"{robot.name} has coupled joints, whose motors cannot be elastic here."
            )
        dofs = np.asarray(robot.torque_dofs)
        if self.stiffness is None:
            load = _typical_load(robot)[dofs]
            K = np.maximum(load, 0.01 * load.max()) / self.windup
        else:
            K = np.broadcast_to(np.asarray(self.stiffness, dtype=float), dofs.shape).copy()
        gap = np.full(len(dofs), self.gap)
        inertia = robot.joint_terms.armature[dofs]
        return Transmission(K, self.damping * K, gap, inertia, self.encoders == "motor")


def _typical_load(robot: RobotModel) -> Array:
    """Root sum of squares (nv,) of RMS gravity torque and torque of half the acceleration limit."""
    limit = np.where(np.isfinite(robot.limits.a), robot.limits.a, 0.0)
    inertia = np.diag(mass_matrix(robot.mj))
    return np.asarray(np.hypot(gravity_rms(robot, robot.mj), 0.5 * inertia * limit))
