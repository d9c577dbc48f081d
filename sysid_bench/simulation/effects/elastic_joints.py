"""Elastic joints: rotors behind springs, with backlash, and encoders on either side."""

from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np

from sysid_bench.errors import UnsupportedError, unknown_name
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.elastic_drives import ElasticDrives
from sysid_bench.simulation.motor_load import mass_matrix, rigid_load
from sysid_bench.simulation.size import Size, check_size, effect_size, joint_size
from sysid_bench.types import Array

LEAST_LOAD: Final = 0.01
"""Smallest load of a joint that a transmission is made for, over that of the most loaded joint."""

LEAST_ROTOR: Final = 1e-3
"""Rotor inertia over the joint's diagonal element of the mass matrix, below which a rotor counts as
one without inertia: it would oscillate more than 30 times faster than its joint."""


@dataclass(frozen=True)
class ElasticJoints:
    """Elastic transmission of every motor (Spong 1987), see `elastic_drives.py`.

    `stiffness` (N m/rad, N/m) is one number or one per motor; without it K is the joint's
    typical load, at least 1 % of that of the most loaded joint of its kind (hinges, slides), over
    `windup`: transmissions of arms have 5e3 to 5e4 N m/rad and wind up by 0.3 to 2 mrad. The
    typical load is the RMS gravity torque over random postures, and the torque of half the
    acceleration limit. `damping` is D over K (s). `gap` is half the backlash; published values of
    the whole are 0.1 to 1 mrad (assumed), those of industrial gears below 0.3 mrad (1 arcmin, as
    data sheets state). The rotors have the armature of the robot; a motor without any has no gap,
    which it would cross in no time, again and again; one below LEAST_ROTOR
    counts as none. `encoders` are on the "motor" or the "link".
    """

    stiffness: Size | None = None
    windup: Size = field(default=1e-3, metadata={"unit": "rad|m"})
    damping: Size = field(default=1e-4, metadata={"unit": "s"})
    gap: Size = field(default=0.0, metadata={"unit": "rad|m"})
    encoders: str = "motor"
    sizes: ClassVar[tuple[str, ...]] = ("windup", "gap")
    vanishes_at_rest: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for negative sizes, and encoders on neither side."""
        check_size("Size of 'elastic-joints'", self.windup, self.damping, self.gap)
        if self.stiffness is not None:
            check_size("stiffness of 'elastic-joints'", self.stiffness, above=True)
        if self.encoders not in ("motor", "link"):
            raise unknown_name("side of encoders", self.encoders, ("motor", "link"))

    @staticmethod
    def size_names(robot: RobotModel) -> tuple[str, ...]:
        """Return the names of the motors that a list of sizes is for."""
        return robot.torque_rows

    def prepare(self, robot: RobotModel) -> ElasticDrives | None:
        """Return the transmission; None for rigid ones, of no windup and gap.

        Raises UnsupportedError for coupled joints.
        """
        names = robot.torque_rows
        windup, damping, gap = (
            joint_size(getattr(self, name), names, name) for name in ("windup", "damping", "gap")
        )
        soft = effect_size(windup, "windup")
        if self.stiffness is None and soft is None:
            return None
        if robot.coupling is not None:
            raise UnsupportedError(
                f"{robot.name} has coupled joints, whose motors cannot be elastic here."
            )
        dofs = np.asarray(robot.torque_dofs)
        if self.stiffness is None:
            K = least_load(robot, rigid_load(robot))[dofs] / soft
        else:
            K = joint_size(self.stiffness, names, "stiffness")
        inertia = robot.joint_terms.armature[dofs]
        inertia = np.where(
            inertia < LEAST_ROTOR * np.diag(mass_matrix(robot.mj))[dofs], 0.0, inertia
        )
        crossed = np.where(inertia > 0, gap, 0.0)
        return ElasticDrives(K, damping * K, crossed, inertia, self.encoders == "motor")


def least_load(robot: RobotModel, load: Array) -> Array:
    """Return loads (nv,), N m or N, raised to LEAST_LOAD of the largest one of their kind of joint:
    newtons of slides do not compare with newton metres."""
    raised = load.copy()
    for kind in ("hinge", "slide"):
        same = [joint.vadr for joint in robot.joints if joint.kind == kind]
        raised[same] = np.maximum(load[same], LEAST_LOAD * load[same].max(initial=0.0))
    return raised
