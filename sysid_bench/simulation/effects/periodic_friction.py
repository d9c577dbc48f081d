"""Position-periodic friction: teeth and eccentric gears rub more at some angles than at others."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import friction_scale
from sysid_bench.simulation.harmonics import PeriodicLaw, periodic_law
from sysid_bench.simulation.size import Size, check_size, joint_size


@dataclass(frozen=True)
class Periodic:
    """Torque x Fc s on every hinge and slide, x = sum_k a_k sin(k (N q + p)), k = 1, 2, 4 per motor
    revolution (Popovic, Goldenberg 1998), with s the direction of friction.

    `first`, `second` and `fourth` are a_k, 1 to 5 % each (to be verified), and less than 100 % in
    all. `ratio` is the gear ratio N (1/m on slides), `phase` is p. A joint without Coulomb friction
    is given that of `friction_scale`.
    """

    first: Size = field(default=0.05, metadata={"unit": "%"})
    second: Size = field(default=0.03, metadata={"unit": "%"})
    fourth: Size = field(default=0.01, metadata={"unit": "%"})
    ratio: Size = field(default=100.0, metadata={"unit": "1"})
    phase: Size = field(default=0.0, metadata={"unit": "rad"})
    width: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("first", "second", "fourth")
    vanishes_at_rest: ClassVar[bool] = True
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for sizes with which friction drives a joint."""
        what = "ratio or width of the effect 'periodic-friction'"
        check_size(what, self.ratio, self.width, above=True)
        largest = [np.abs(np.asarray(x, dtype=float)).max() for x in
                   (self.first, self.second, self.fourth)]  # fmt: skip
        if not sum(largest) < 1:
            raise UsageError(
                "The sizes of the effect 'periodic-friction' are less than 100 % in all, since "
                "friction dissipates at every angle."
            )

    def prepare(self, robot: RobotModel) -> PeriodicLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        rows, scale = robot.rows, friction_scale(robot)
        sizes = np.array([joint_size(getattr(self, name), rows, name) for name in self.sizes])
        return periodic_law(
            robot,
            np.array([1.0, 2.0, 4.0]),
            sizes,
            (joint_size(self.ratio, rows, "ratio"), joint_size(self.phase, rows, "phase")),
            friction=(
                scale.coulomb, scale.missing * sizes.any(axis=0),
                joint_size(self.width, rows, "width"),
            ),
        )  # fmt: skip
