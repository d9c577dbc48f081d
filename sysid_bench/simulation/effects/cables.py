"""Cable forces: dress packs that bend and rub as joints move."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.friction import play_position
from sysid_bench.simulation.motor_load import rigid_load
from sysid_bench.simulation.size import Size, check_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Cables:
    """Torque K (q - q0) + H (q - p) / w on every hinge and slide: a spring about the centre of the
    joint's range, and hysteresis by play of the half width w (`friction.py`).

    K times half the range (at most half a turn) is the share `bending` of the joint's typical load
    (RMS gravity torque, and torque of half the acceleration limit), H the share `hysteresis`.
    Dress packs of arms take 1 to 10 N m (to be verified), 1 to 5 % of it. `width` is w.
    """

    bending: Size = field(default=0.03, metadata={"unit": "%"})
    hysteresis: Size = field(default=0.01, metadata={"unit": "%"})
    width: Size = field(default=0.05, metadata={"unit": "rad|m"})
    sizes: ClassVar[tuple[str, ...]] = ("bending", "hysteresis")
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for negative sizes."""
        check_size("Size of the effect 'cables'", self.bending, self.hysteresis)
        check_size("width of the effect 'cables'", self.width, above=True)

    def prepare(self, robot: RobotModel) -> "_CableLaw | None":
        """Return the force law for this robot; None for sizes of zero."""
        names = ("bending", "hysteresis", "width")
        sizes = (joint_size(getattr(self, name), robot.rows, name) for name in names)
        bending, hysteresis, width = sizes
        if not (bending.any() or hysteresis.any()):
            return None
        load = np.where(np.isin(np.arange(robot.nv), robot.scalar_dofs), rigid_load(robot), 0.0)
        low, high = robot.limits.q_low, robot.limits.q_high
        limited = np.isfinite(low) & np.isfinite(high) & (high > low)
        low, high = np.where(limited, low, -np.pi), np.where(limited, high, np.pi)
        half, centre = np.minimum(0.5 * (high - low), np.pi), 0.5 * (low + high)
        numbers = [bending * load / half, centre, hysteresis * load, width]
        return _CableLaw(np.concatenate(numbers))


@dataclass(frozen=True, eq=False)
class _CableLaw:
    """Force law of cables; `numbers` (4 nv,) are K, q0, H, w."""

    numbers: Array
    kind: str = "cables"

    @property
    def stiffness(self) -> Array:
        """Stiffness before the cables rub (nv,)."""
        K, _, H, width = self.numbers.reshape(4, -1)
        return np.asarray(K + H / width)

    def start(self, q: Array, v: Array) -> Array:
        """Return the play's position (nv,): behind a moving joint, centred at rest."""
        return np.asarray(q - self.numbers.reshape(4, -1)[3] * np.sign(v))

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) and the play's position after a step."""
        K, centre, H, width = self.numbers.reshape(4, -1)
        p = play_position(state, q, width)
        return K * (q - centre) + H * ((q - p) / width), p
