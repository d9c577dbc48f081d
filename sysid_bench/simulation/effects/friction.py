"""Friction with a rate-independent transition at each reversal, which effects share.

The direction of friction is the normalised play (q - p) / w, p+ = clip(p, q - w, q + w): a spring
of width w before a joint slides, sign(v) while it slides.
"""

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.motor_load import acting_dofs, acting_gravity, rigid_load
from sysid_bench.simulation.size import Size, check_size, joint_size, joint_sizes
from sysid_bench.types import Array

ASSUMED_FRICTION: Final = 0.05
"""Coulomb friction of a joint that has none in the robot's file, over its RMS gravity torque."""

PEAK_LOAD: Final = 2.0
"""Load that internal springs are followed up to, over the typical one."""


@dataclass(frozen=True, eq=False)
class FrictionScale:
    """Coulomb friction (nv,) that sizes of effects refer to, and the part of it that the robot
    does not have; viscous friction (nv,), likewise.

    Where a hinge or slide has none, Coulomb friction of ASSUMED_FRICTION of its RMS gravity torque
    (at least 0.1 % of that of the most loaded joint) stands in, and the same force at the velocity
    limit as viscous friction. The effect adds the missing part, so that the sum dissipates.
    """

    coulomb: Array
    missing: Array
    viscous: Array
    missing_viscous: Array


def friction_scale(robot: RobotModel) -> FrictionScale:
    """Return the friction that sizes of effects refer to."""
    assumed = ASSUMED_FRICTION * acting_gravity(robot)
    own = robot.joint_terms
    missing = np.where(own.coulomb > 0, 0.0, assumed)
    assumed = assumed / rate_limit(robot)
    missing_viscous = np.where(own.viscous > 0, 0.0, assumed)
    return FrictionScale(
        own.coulomb + missing, missing, own.viscous + missing_viscous, missing_viscous
    )


def rate_limit(robot: RobotModel) -> Array:
    """Return the velocity limits (nv,); 1 rad/s or m/s where there is none."""
    limit = robot.limits.v
    return np.where(np.isfinite(limit) & (limit > 0), limit, 1.0)


def play_position(p: Array, q: Array, width: Array) -> Array:
    """Return the play's position (nv,) after a motion to q (nv,)."""
    return np.asarray(np.clip(p, q - width, q + width))


@dataclass(frozen=True, eq=False)
class FrictionTerms:
    """Coefficients of a friction law, one number or one by degree of freedom (nv,)."""

    coulomb: Array | float = 0.0  # Fc
    asymmetry: Array | float = 0.0  # ca: half of forward minus backward friction
    load: Array | float = 0.0  # kl
    viscous: Array | float = 0.0  # Fv
    viscous_asymmetry: Array | float = 0.0  # cv
    load_viscous: Array | float = 0.0  # kv
    curvature: Array | float = 0.0  # cc


@dataclass(frozen=True, eq=False)
class FrictionLaw:
    """tau = exp(-(t + elapsed) decay) ((Fc + kl |load|) s + ca |s| + (Fv + kv |load|) v + cv |v| +
    cc |v| v), with s the direction of friction."""

    terms: Array  # (7, nv), in the order of FrictionTerms
    width: Array  # w (nv,) of the transition (rad, m)
    most_load: Array  # (nv,), N m or N, for the choice of the step
    most_speed: Array  # (nv,), rad/s or m/s, likewise
    decay: tuple[float, float] = (0.0, 0.0)  # rate (1/s) and elapsed time (s)
    replaces: tuple[str, ...] = ()
    kind: str = "friction"

    @cached_property
    def numbers(self) -> Array:
        """All coefficients, as steps.c reads them."""
        return np.concatenate([self.width, self.terms.ravel(), self.decay])

    @property
    def stiffness(self) -> Array:
        """Stiffness of the play (nv,)."""
        Fc, ca, kl = np.abs(self.terms[:3])
        return np.asarray((Fc + ca + kl * self.most_load) / self.width)

    @property
    def damping(self) -> Array:
        """Largest gradient of the torque over velocity (nv,)."""
        Fv, cv, kv, cc = np.abs(self.terms[3:])
        return np.asarray(Fv + cv + kv * self.most_load + 2 * cc * self.most_speed)

    def start(self, q: Array, v: Array) -> Array:
        """Return the play's position (nv,): behind a moving joint, centred at rest."""
        return np.asarray(q - self.width * np.sign(v))

    def step(
        self, state: Array, h: float, t: float, q: Array, v: Array, load: Array
    ) -> tuple[Array, Array]:
        """Return the torque (nv,) and the play's position after a step."""
        Fc, ca, kl, Fv, cv, kv, cc = self.terms
        rate, elapsed = self.decay
        p = play_position(state, q, self.width)
        s, size, speed = (q - p) / self.width, np.abs(load), np.abs(v)
        force = (Fc + kl * size) * s + ca * np.abs(s)
        force = force + (Fv + kv * size + cc * speed) * v + cv * speed
        return np.exp(-(t + elapsed) * rate) * force, p


def friction_law(
    robot: RobotModel,
    width: Array,
    terms: FrictionTerms,
    decay: tuple[float, float] = (0.0, 0.0),
    replaces: tuple[str, ...] = (),
) -> FrictionLaw | None:
    """Return the law with these terms on hinges and slides; None where all are zero."""
    acting = acting_dofs(robot)
    stacked = np.array([acting * getattr(terms, f.name) for f in fields(FrictionTerms)])
    if not stacked.any():
        return None
    load = PEAK_LOAD * rigid_load(robot)
    speed = rate_limit(robot)
    return FrictionLaw(stacked, np.where(acting, width, 1.0), load, speed, decay, replaces)


# Gears rub otherwise forwards than backwards: the other flanks of their teeth carry.
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
        check_size("width of the effect 'asymmetric-friction'", self.width, above=True)
        for share in (self.coulomb, self.viscous):
            if not (np.abs(np.asarray(share, dtype=float)) < 1).all():
                raise UsageError(
                    f"Asymmetry {share!r} of the effect 'asymmetric-friction': give less than "
                    "100 %, since friction dissipates in both directions."
                )

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None where friction is symmetric."""
        scale = friction_scale(robot)
        names = ("coulomb", "viscous", "width")
        coulomb, viscous, width = joint_sizes(self, robot.rows, *names)
        terms = FrictionTerms(
            coulomb=scale.missing * (coulomb != 0),
            asymmetry=coulomb * scale.coulomb,
            viscous=scale.missing_viscous * (viscous != 0),
            viscous_asymmetry=viscous * scale.viscous,
        )
        return friction_law(robot, width, terms)


# Greases thin under shear: friction grows less than in proportion to the velocity.
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


# Teeth and bearings rub more under the torque that they transmit.
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
        check_size("Size of the effect 'load-friction'", self.coulomb, self.viscous)
        check_size("width of the effect 'load-friction'", self.width, above=True)
        if not (np.asarray(self.coulomb, dtype=float) <= 0.5).all():
            raise UsageError(
                f"coulomb = {self.coulomb!r} of the effect 'load-friction': give 50 % or less of "
                "the load; beyond that a gear locks itself."
            )

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        names = ("coulomb", "viscous", "width")
        coulomb, viscous, width = joint_sizes(self, robot.rows, *names)
        return friction_law(robot, width, FrictionTerms(load=coulomb, load_viscous=viscous))


# A cold robot rubs more, since grease is viscous, until it is warm.
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
        check_size("Size of the effect 'warm-up'", self.viscous, self.coulomb, self.elapsed)
        check_size("Time or width of the effect 'warm-up'", self.time, self.width,
                           above=True)  # fmt: skip

    def prepare(self, robot: RobotModel) -> FrictionLaw | None:
        """Return the force law for this robot; None for sizes of zero."""
        scale = friction_scale(robot)
        names = ("coulomb", "viscous", "width")
        coulomb, viscous, width = joint_sizes(self, robot.rows, *names)
        terms = FrictionTerms(coulomb=coulomb * scale.coulomb, viscous=viscous * scale.viscous)
        return friction_law(robot, width, terms, decay=(1.0 / self.time, self.elapsed))
