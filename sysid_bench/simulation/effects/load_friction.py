"""Load-dependent friction: teeth and bearings rub more under the torque that they transmit."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import FrictionLaw, FrictionTerms, friction_law
from sysid_bench.simulation.size import Size, check_size, joint_size


@dataclass(frozen=True)
class LoadFriction:
    """Torque kl |tau_e| s + kv |tau_e| v on every hinge and slide (Bittencourt, Gunnarsson 2012),
    with tau_e the torque on the links and s the direction of friction, of transition `width`.

    `coulomb` is kl: 1 to 10 % of the transmitted torque (to be verified). `viscous` is kv (s/rad,
    s/m). A model with load and temperature cut the friction error 6-fold (Bittencourt et al. 2010);
    of moving rows of recorded arms it explains up to 21 %.
    """

    coulomb: Size = field(default=0.05, metadata={"unit": "%"})
    viscous: Size = field(default=0.0, metadata={"unit": "1"})
    width: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("coulomb", "viscous")
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for negative sizes, and for friction above half of the load."""
        check_size("Size of the effect 'load-friction'", self.coulomb, self.viscous)
        check_size("width of the effect 'load-friction'", self.width, above=True)
        if not (np.asarray(self.coulomb, dtype=float) <= 0.5).all():
            raise UsageError(
                f"coulomb = {self.coulomb!r} of the effect 'load-friction': give 50 % or less of "
                "the load; beyond that a gear locks itself."
            )

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        rows = robot.rows
        terms = FrictionTerms(
            load=joint_size(self.coulomb, rows, "coulomb"),
            load_viscous=joint_size(self.viscous, rows, "viscous"),
        )
        return friction_law(robot, joint_size(self.width, rows, "width"), terms)
