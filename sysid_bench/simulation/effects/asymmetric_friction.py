"""Asymmetric friction: other friction forwards than backwards."""

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
)
from sysid_bench.simulation.size import Size, check_size, joint_size


@dataclass(frozen=True)
class Asymmetric:
    """Coulomb friction (1 + `coulomb`) Fc for v > 0 and (1 - `coulomb`) Fc for v < 0 (Armstrong
    1988), viscous friction likewise.

    Torque c Fc |s| + b Fv |v| on every hinge and slide, with s the direction of friction, whose
    transition has the `width` w. The two directions of gears differ by 5 to 20 % (to be verified).
    A joint without Coulomb or viscous friction is given that of `friction_scale`.
    """

    coulomb: Size = field(default=0.1, metadata={"unit": "%"})
    viscous: Size = field(default=0.1, metadata={"unit": "%"})
    width: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("coulomb", "viscous")
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for shares of 100 % or more, with which friction drives a joint."""
        check_size("width of the effect 'asymmetric-friction'", self.width, above=True)
        for share in (self.coulomb, self.viscous):
            if not (np.abs(np.asarray(share, dtype=float)) < 1).all():
                raise UsageError(
                    f"Asymmetry {share!r} of the effect 'asymmetric-friction': give less than "
                    "100 %, since friction dissipates in both directions."
                )

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None where friction is symmetric."""
        rows, scale = robot.rows, friction_scale(robot)
        coulomb = joint_size(self.coulomb, rows, "coulomb")
        viscous = joint_size(self.viscous, rows, "viscous")
        terms = FrictionTerms(
            coulomb=scale.missing * (coulomb != 0),
            asymmetry=coulomb * scale.coulomb,
            viscous=scale.missing_viscous * (viscous != 0),
            viscous_asymmetry=viscous * scale.viscous,
        )
        return friction_law(robot, joint_size(self.width, rows, "width"), terms)
