"""LuGre friction: presliding with true rest, hysteresis and the Stribeck effect."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.types import Array


@dataclass(frozen=True)
class LuGre:
    """Coulomb friction of every hinge and slide with elastic bristles (Canudas de Wit, Olsson,
    Astrom, Lischinsky 1995, eqs. 4 to 7).

    g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2), dz/dt = v - sigma0 |v| z / g(v), torque sigma0 z +
    sigma1 dz/dt. Fc is the robot's Coulomb friction, Fs = (1 + `peak`) Fc, sigma0 = Fc /
    `presliding`: published presliding distances of gears are 0.2 to 2 mrad. `damping` is sigma1
    over sigma0 (s). A presliding distance of zero is the robot's own Coulomb friction.
    """

    presliding: float = field(default=5e-4, metadata={"unit": "rad|m"})
    peak: float = field(default=0.0, metadata={"unit": "%"})
    vs: float = field(default=0.05, metadata={"unit": "rad|m"})  # per second
    damping: float = field(default=1e-3, metadata={"unit": "s"})
    vanishes_at_rest: ClassVar[bool] = False

    def prepare(self, robot: RobotModel) -> "_LuGreLaw | None":
        """Return the force law for this robot; None without presliding."""
        if self.presliding == 0:
            return None
        Fc = robot.joint_terms.coulomb
        sigma0 = Fc / self.presliding
        numbers = [Fc, (1 + self.peak) * Fc, sigma0, self.damping * sigma0, np.array([self.vs])]
        return _LuGreLaw(np.concatenate(numbers))


@dataclass(frozen=True, eq=False)
class _LuGreLaw:
    """Force law of LuGre friction; `numbers` (4 nv + 1,) are Fc, Fs, sigma0, sigma1, vs."""

    numbers: Array
    kind: str = "lugre"
    replaces: tuple[str, ...] = ("coulomb",)

    @property
    def stiffness(self) -> Array:
        """sigma0 (nv,)."""
        return np.asarray(self.numbers[:-1].reshape(4, -1)[2])

    @property
    def viscosity(self) -> Array:
        """sigma1 (nv,)."""
        return np.asarray(self.numbers[:-1].reshape(4, -1)[3])

    def start(self, q: Array, v: Array) -> Array:
        """Return the bristles' deflections z (nv,) in steady sliding; zero at rest."""
        Fc, _, sigma0, _ = self.numbers[:-1].reshape(4, -1)
        return np.asarray(np.sign(v) * Fc / np.where(sigma0 > 0, sigma0, 1.0))

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) and the deflections after a step, exact while v is constant."""
        Fc, Fs, sigma0, sigma1 = self.numbers[:-1].reshape(4, -1)
        acting = Fc > 0
        scale = np.where(acting, sigma0, 1.0)
        g = np.where(acting, Fc + (Fs - Fc) * np.exp(-((v / self.numbers[-1]) ** 2)), 1.0)
        end = np.sign(v) * g / scale
        z = np.where(v == 0, state, end + (state - end) * np.exp(-scale * np.abs(v) * h / g))
        torque = sigma0 * z + sigma1 * (z - state) / h
        return np.where(acting, torque, 0.0), np.where(acting, z, 0.0)
