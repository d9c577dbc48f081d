"""Play: Coulomb friction with a spring-like transition at each reversal, independent of rate."""

from dataclasses import dataclass, field
from typing import ClassVar

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import FrictionLaw, FrictionTerms, friction_law
from sysid_bench.simulation.size import Size, check_size, effect_size, joint_size


@dataclass(frozen=True)
class Play:
    """Coulomb friction Fc (q - p) / w of every hinge and slide, p+ = clip(p, q - w, q + w), one
    element of a generalised Maxwell-slip model (Al-Bender, Lampaert, Swevers 2005).

    A cycle of amplitude A > w dissipates 4 Fc (A - w). `width` is w, half of the motion that turns
    friction around: 0.2 to 2 mrad in published measurements of gears, and up to a share of 25 % of
    the residual of recorded arms. A width of zero is the robot's own Coulomb friction.
    """

    width: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("width",)
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for a negative width."""
        check_size("width of the effect 'play'", self.width)

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None without a width or without friction.

        Raises UsageError where some joints have a width and others do not.
        """
        width = effect_size(joint_size(self.width, robot.rows, "width"), "width")
        if width is None:
            return None
        terms = FrictionTerms(coulomb=robot.joint_terms.coulomb)
        return friction_law(robot, width, terms, replaces=("coulomb",))
