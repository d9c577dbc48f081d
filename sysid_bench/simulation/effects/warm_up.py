"""Temperature-dependent friction: a cold robot rubs more, until it is warm."""

from dataclasses import dataclass, field
from typing import ClassVar

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import (
    FrictionLaw,
    FrictionTerms,
    friction_law,
    friction_scale,
)
from sysid_bench.simulation.size import Size, check_size, joint_size


@dataclass(frozen=True)
class WarmUp:
    """Viscous and Coulomb friction of every hinge and slide times 1 + r exp(-(t + t0) / T), t from
    the start of a motion (Bittencourt et al. 2010, for one speed and load).

    `viscous` and `coulomb` are r: friction falls by 30 to 50 % from cold to warm (to be verified),
    r = 0.4 to 1. `time` is T; `elapsed` is t0, how long the robot has warmed up before. The
    direction of friction has a transition of `width`. A joint without Coulomb or viscous friction
    refers to that of `friction_scale`.
    """

    viscous: Size = field(default=0.6, metadata={"unit": "%"})
    coulomb: Size = field(default=0.2, metadata={"unit": "%"})
    time: float = field(default=1800.0, metadata={"unit": "s"})
    elapsed: float = field(default=0.0, metadata={"unit": "s"})
    width: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("viscous", "coulomb")
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for negative sizes and times."""
        check_size("Size of the effect 'warm-up'", self.viscous, self.coulomb, self.elapsed)
        check_size("Time or width of the effect 'warm-up'", self.time, self.width,
                           above=True)  # fmt: skip

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        rows, scale = robot.rows, friction_scale(robot)
        terms = FrictionTerms(
            coulomb=joint_size(self.coulomb, rows, "coulomb") * scale.coulomb,
            viscous=joint_size(self.viscous, rows, "viscous") * scale.viscous,
        )
        width = joint_size(self.width, rows, "width")
        return friction_law(robot, width, terms, decay=(1.0 / self.time, self.elapsed))
