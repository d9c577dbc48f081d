"""Friction with a rate-independent transition at each reversal, which effects share.

The direction of friction is the normalised play (q - p) / w, p+ = clip(p, q - w, q + w): a spring
of width w before a joint slides, sign(v) while it slides.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.models.robot import RobotModel
from sysid_bench.simulation.gravity import gravity_rms
from sysid_bench.simulation.motor_load import rigid_load
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
    gravity = gravity_rms(robot, robot.mj)
    assumed = np.zeros(robot.nv)
    dofs = robot.scalar_dofs
    assumed[dofs] = ASSUMED_FRICTION * np.maximum(gravity, 1e-3 * gravity.max())[dofs]
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
    acting = np.isin(np.arange(robot.nv), robot.scalar_dofs)
    stacked = np.array([acting * getattr(terms, f.name) for f in fields(FrictionTerms)])
    if not stacked.any():
        return None
    load = PEAK_LOAD * rigid_load(robot)
    speed = rate_limit(robot)
    return FrictionLaw(stacked, np.where(acting, width, 1.0), load, speed, decay, replaces)
