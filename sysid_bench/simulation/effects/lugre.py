"""LuGre friction: presliding with true rest, hysteresis and the Stribeck effect."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.size import Size, check_size, effect_size, joint_size
from sysid_bench.types import Array


@dataclass(frozen=True)
class Lugre:
    """Coulomb friction of every hinge and slide with elastic bristles (Canudas de Wit, Olsson,
    Astrom, Lischinsky 1995, eqs. 4 to 7).

    g(v) = Fc + (Fs - Fc) exp(-(v/vs)^2), dz/dt = v - sigma0 |v| z / g(v), torque sigma0 z +
    sigma1 dz/dt. Fc is the robot's Coulomb friction, Fs = (1 + `peak`) Fc, sigma0 = Fc /
    `presliding`. In training residuals of recorded robots (`reports/reference/levels.md`) the best
    transition is 0.1 to 5 mrad wide, and peaks lie between none and 25 %; published peaks of 20 to
    60 % are assumed to be those of cold or greased gears. `damping` is sigma1 over sigma0 (s). A
    presliding distance of zero is the robot's own Coulomb friction; a joint without Coulomb
    friction has no bristles.
    """

    presliding: Size = field(default=5e-4, metadata={"unit": "rad|m"})
    peak: Size = field(default=0.0, metadata={"unit": "%"})
    vs: Size = field(default=0.05, metadata={"unit": "rad|m"})  # per second
    damping: Size = field(default=1e-3, metadata={"unit": "s"})
    sizes: ClassVar[tuple[str, ...]] = ("presliding",)
    vanishes_at_rest: ClassVar[bool] = False
    dissipates: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise UsageError for negative sizes, and for a Stribeck velocity of zero."""
        check_size("Size of the effect 'lugre'", self.presliding, self.peak, self.damping)
        check_size("vs of the effect 'lugre'", self.vs, above=True)

    def prepare(self, robot: RobotModel) -> "_LuGreLaw | None":
        """Return the force law for this robot; None without presliding.

        Raises UsageError where some joints have a presliding distance and others do not.
        """
        names = ("presliding", "peak", "vs", "damping")
        sizes = (joint_size(getattr(self, name), robot.rows, name) for name in names)
        distance, peak, vs, damping = sizes
        presliding = effect_size(distance, "presliding")
        if presliding is None:
            return None
        Fc = robot.joint_terms.coulomb
        sigma0 = Fc / presliding
        return _LuGreLaw(np.concatenate([Fc, (1 + peak) * Fc, sigma0, damping * sigma0, vs]))


@dataclass(frozen=True, eq=False)
class _LuGreLaw:
    """Force law of LuGre friction; `numbers` (5 nv,) are Fc, Fs, sigma0, sigma1, vs."""

    numbers: Array
    kind: str = "lugre"
    replaces: tuple[str, ...] = ("coulomb",)

    @property
    def stiffness(self) -> Array:
        """sigma0 (nv,)."""
        return np.asarray(self.numbers.reshape(5, -1)[2])

    @property
    def damping(self) -> Array:
        """sigma1 (nv,)."""
        return np.asarray(self.numbers.reshape(5, -1)[3])

    def start(self, q: Array, v: Array) -> Array:
        """Return the bristles' deflections z (nv,) in steady sliding; zero at rest."""
        Fc, _, sigma0, *_ = self.numbers.reshape(5, -1)
        return np.asarray(np.sign(v) * Fc / np.where(sigma0 > 0, sigma0, 1.0))

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) and the deflections after a step, exact while v is constant."""
        Fc, Fs, sigma0, sigma1, vs = self.numbers.reshape(5, -1)
        acting = Fc > 0
        scale = np.where(acting, sigma0, 1.0)
        g = np.where(acting, Fc + (Fs - Fc) * np.exp(-((v / vs) ** 2)), 1.0)
        end = np.sign(v) * g / scale
        z = np.where(v == 0, state, end + (state - end) * np.exp(-scale * np.abs(v) * h / g))
        torque = sigma0 * z + sigma1 * (z - state) / h
        return np.where(acting, torque, 0.0), np.where(acting, z, 0.0)
