"""Friction near standstill: the Stribeck effect, bristles (LuGre) and play."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.effects.friction import FrictionLaw, FrictionTerms, friction_law
from sysid_bench.simulation.motor_load import acting_gravity
from sysid_bench.simulation.size import Size, check_size, effect_size, joint_size, joint_sizes
from sysid_bench.types import Array


# The film of lubricant carries more of the load with speed, so that friction decreases with it.
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
        check_size("share of the effect 'stribeck'", self.share)
        check_size("vs or v0 of the effect 'stribeck'", self.vs, self.v0, above=True)

    def prepare(self, robot: RobotModel) -> "StribeckLaw | None":
        """Return the force law for this robot; None for a share of zero."""
        share, vs, v0 = joint_sizes(self, robot.rows, "share", "vs", "v0")
        if not share.any():
            return None
        return StribeckLaw(np.concatenate([share * acting_gravity(robot), vs, v0]))


@dataclass(frozen=True, eq=False)
class StribeckLaw:
    """Force law of Stribeck friction; `numbers` (3 nv,) are F, vs, v0."""

    numbers: Array
    kind: str = "stribeck"

    def __call__(self, t: Array, q: Array, v: Array) -> Array:
        """Return the torque (..., nv) at v (..., nv)."""
        scale, vs, v0 = self.numbers.reshape(3, -1)
        return np.asarray(scale * np.exp(-((v / vs) ** 2)) * np.tanh(v / v0))


# Bristles hold at rest, bend before they slide, and so dissipate in presliding cycles, too.
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
        check_size("Size of the effect 'lugre'", self.presliding, self.peak, self.damping)
        check_size("vs of the effect 'lugre'", self.vs, above=True)

    def prepare(self, robot: RobotModel) -> "_LuGreLaw | None":
        """Return the force law for this robot; None without presliding.

        Raises UsageError where some joints have a presliding distance and others do not.
        """
        names = ("presliding", "peak", "vs", "damping")
        distance, peak, vs, damping = joint_sizes(self, robot.rows, *names)
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


# A spring-like transition at each reversal, independent of rate.
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
