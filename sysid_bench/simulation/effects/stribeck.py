"""Stribeck friction: friction that decreases with speed near standstill."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Stribeck:
    """Torque F exp(-(v/vs)^2) tanh(v/v0) on every hinge and slide (Armstrong-Helouvry 1991, eq.
    3.1).

    F is the fraction `share` of the joint's RMS gravity torque over random postures (at least 0.1 %
    of that of the most loaded joint), so that one setting suits small and large arms. `vs` is the
    Stribeck velocity, `v0` the width of the smooth sign (rad/s, m/s).
    """

    share: Size = field(default=0.1, metadata={"unit": "%"})
    vs: Size = field(default=0.1, metadata={"unit": "rad|m"})  # per second
    v0: Size = field(default=0.005, metadata={"unit": "rad|m"})  # per second
    sizes: ClassVar[tuple[str, ...]] = ("share",)
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for negative sizes, and for velocities of zero."""
        check_size("share of the effect 'stribeck'", self.share)
        check_size("vs or v0 of the effect 'stribeck'", self.vs, self.v0, above=True)

    def prepare(self, robot: RobotModel) -> "StribeckLaw | None":
        """Return the force law for this robot; None for a share of zero."""
        names = ("share", "vs", "v0")
        share, vs, v0 = (joint_size(getattr(self, name), robot.rows, name) for name in names)
        if not share.any():
            return None
        gravity = gravity_rms(robot, robot.mj)
        gravity = np.maximum(gravity, 1e-3 * gravity.max())
        scale = np.zeros(robot.nv)
        scale[robot.scalar_dofs] = (share * gravity)[robot.scalar_dofs]
        return StribeckLaw(np.concatenate([scale, vs, v0]))


@dataclass(frozen=True, eq=False)
class StribeckLaw:
    """Force law of Stribeck friction; `numbers` (3 nv,) are F, vs, v0."""

    numbers: Array
    kind: str = "stribeck"

    def __call__(self, t: Array, q: Array, v: Array) -> Array:
        """Return the torque (..., nv) at v (..., nv)."""
        scale, vs, v0 = self.numbers.reshape(3, -1)
        return np.asarray(scale * np.exp(-((v / vs) ** 2)) * np.tanh(v / v0))
