"""Which parameters can exist: the set that feasible fits look in, built once per robot.

A body can exist iff its pseudo-inertia J(phi) (4, 4) is positive definite (Wensing, Kim, Slotine
2018). With lengths in LENGTH the margin J >= margin tr(J) 1 is linear in phi, scaled to each body
without knowing its mass, and satisfied by a body of nothing. Friction, rotor inertia and stiffness
are not negative.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from sysid_bench.spatial.inertia import pseudo_inertia
from sysid_bench.types import Array, Body, Problem

LENGTH: Final = 0.1
"""m; the size of a robot's link, in which inertias of a kilogram are of the order of one."""

NOT_NEGATIVE: Final = (".fv", ".fc", ".Ia", ".k")
"""Endings of joint terms that take energy or store it."""

SCALE: Final = np.array([1.0] + [LENGTH] * 3 + [LENGTH**2] * 6)
"""phi (10,) of a body of 1 kg and LENGTH."""

_UNITS: Final = np.diag([1 / LENGTH] * 3 + [1.0])
BASIS: Final = _UNITS @ pseudo_inertia(np.diag(SCALE)) @ _UNITS
"""dJ/dx (10, 4, 4), J in LENGTH and kg, of phi = SCALE x."""


@dataclass(frozen=True, eq=False)
class FeasibleSet:
    """The places of bodies and joint terms in x (p,), theta = scale x."""

    parameters: tuple[str, ...]
    bodies: tuple[Body, ...]

    @cached_property
    def places(self) -> Array:
        """Of each body's ten numbers (nb, 10)."""
        index = {name: i for i, name in enumerate(self.parameters)}
        places = [[index[column] for column in body.columns] for body in self.bodies]
        return np.array(places, dtype=int).reshape(-1, 10)

    @cached_property
    def nonnegative(self) -> Array:
        """Of the joint terms that are at least zero; coupled viscous friction has either sign."""
        inertial = set(self.places.ravel().tolist())
        return np.array(
            [
                i
                for i, name in enumerate(self.parameters)
                if i not in inertial and name.endswith(NOT_NEGATIVE)
            ],
            dtype=int,
        )

    @cached_property
    def scale(self) -> Array:
        """theta of one x (p,)."""
        scale = np.ones(len(self.parameters))
        scale[self.places] = SCALE
        return scale

    def pseudo_inertias(self, x: Array) -> Array:
        """J (nb, 4, 4) in LENGTH and kg."""
        return np.einsum("bk,kij->bij", x[self.places], BASIS)

    def regularity(self, x: Array) -> Array:
        """The smallest eigenvalue of each J over its trace (nb,): at most 1/4; 0 for nothing."""
        J = self.pseudo_inertias(x)
        trace = np.trace(J, axis1=1, axis2=2)
        smallest = np.linalg.eigvalsh(J)[:, 0]
        return np.where(
            np.abs(trace) > 1e-12, smallest / np.where(trace == 0, 1.0, np.abs(trace)), smallest
        )


@lru_cache(maxsize=64)
def feasible_set(parameters: tuple[str, ...], bodies: tuple[Body, ...]) -> FeasibleSet:
    """The set of a robot, its places looked up once."""
    return FeasibleSet(parameters, bodies)


def feasible_set_of(problem: Problem) -> FeasibleSet:
    """The set of a problem's parameters."""
    return feasible_set(problem.parameters, problem.bodies)
