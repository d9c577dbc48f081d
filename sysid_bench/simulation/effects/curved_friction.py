"""Curved viscous friction: less or more than in proportion to the velocity."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import (
    FrictionLaw,
    FrictionTerms,
    friction_law,
    friction_scale,
    rate_limit,
)
from sysid_bench.simulation.size import Size, joint_size


@dataclass(frozen=True)
class CurvedFriction:
    """Torque c Fv |v| v / v_limit on every hinge and slide: `curvature` c changes the viscous
    friction Fv at the velocity limit by this share.

    Lubricated gears rub less than in proportion, c = -10 to -50 % (to be verified); the residuals
    of moving rows of recorded arms hold up to 36 % of it. A joint without viscous friction is given
    that of `friction_scale`.
    """

    curvature: Size = field(default=-0.3, metadata={"unit": "%"})
    sizes: ClassVar[tuple[str, ...]] = ("curvature",)
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for a curvature that lets friction drive a joint."""
        if not (np.asarray(self.curvature, dtype=float) > -1).all():
            raise UsageError(
                f"curvature = {self.curvature!r} of the effect 'curved-friction': give more than "
                "-100 %, since friction dissipates up to the velocity limit."
            )

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None without curvature."""
        scale = friction_scale(robot)
        curvature = joint_size(self.curvature, robot.rows, "curvature")
        terms = FrictionTerms(
            viscous=scale.missing_viscous * (curvature != 0),
            curvature=curvature * scale.viscous / rate_limit(robot),
        )
        return friction_law(robot, np.ones(robot.nv), terms)
