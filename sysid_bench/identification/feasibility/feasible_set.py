"""Feasible set of physically consistent parameters, built once per robot.

A body is physically consistent iff its pseudo-inertia J(phi) (4, 4) is positive definite (Wensing,
Kim, Slotine 2018). With lengths in units of LENGTH, the margin J >= margin tr(J) 1 is linear in
phi, scales with the body's mass and holds for a massless body. Friction and rotor inertia are not
negative; a stiffness may be, since counterbalances and cables act like one.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from sysid_bench.spatial import pseudo_inertia
from sysid_bench.types import Array, Body, Problem

LENGTH: Final = 0.1
"""m; a typical link size: moments of inertia of 1 kg are then of the order of one."""

NOT_NEGATIVE: Final = (".fv", ".fc", ".Ia")
"""Suffixes of viscous and Coulomb friction and of the inertia of rotors."""

SCALE: Final = np.array([1.0] + [LENGTH] * 3 + [LENGTH**2] * 6)
"""phi (10,) of a body of 1 kg and LENGTH."""

_UNITS: Final = np.diag([1 / LENGTH] * 3 + [1.0])
BASIS: Final = _UNITS @ pseudo_inertia(np.diag(SCALE)) @ _UNITS
"""dJ/dx (10, 4, 4), J in LENGTH and kg, of phi = SCALE x."""


@dataclass(frozen=True, eq=False)
class FeasibleSet:
    """Indices of bodies and joint terms in the scaled parameters x (p,), theta = scale x. `signed`:
    joint terms that must not be negative; None: those of NOT_NEGATIVE."""

    parameters: tuple[str, ...]
    bodies: tuple[Body, ...]
    signed: tuple[str, ...] | None = None

    @cached_property
    def indices(self) -> Array:
        """Indices (nb, 10) of the parameters of each body."""
        index = {name: i for i, name in enumerate(self.parameters)}
        indices = [[index[column] for column in body.columns] for body in self.bodies]
        return np.array(indices, dtype=int).reshape(-1, 10)

    @cached_property
    def nonnegative(self) -> Array:
        """Indices (k,) of non-negative joint terms; coupled viscous friction has either sign."""
        inertial = set(self.indices.ravel().tolist())
        found = [i for i, name in enumerate(self.parameters) if self._is_signed(name)]
        return np.array([i for i in found if i not in inertial], dtype=int)

    def _is_signed(self, name: str) -> bool:
        return name.endswith(NOT_NEGATIVE) if self.signed is None else name in self.signed

    @cached_property
    def scale(self) -> Array:
        """Scale (p,): theta of x = 1."""
        scale = np.ones(len(self.parameters))
        scale[self.indices] = SCALE
        return scale

    def pseudo_inertia(self, x: Array) -> Array:
        """Pseudo-inertias J (nb, 4, 4), lengths in LENGTH, kg."""
        return np.asarray(np.einsum("bk,kij->bij", x[self.indices], BASIS))

    def relative_margins(self, x: Array) -> Array:
        """Smallest eigenvalue of each J over its trace (nb,), at most 1/4; 0 if massless."""
        J = self.pseudo_inertia(x)
        trace = np.trace(J, axis1=1, axis2=2)
        smallest = np.linalg.eigvalsh(J)[:, 0]
        return np.where(
            np.abs(trace) > 1e-12, smallest / np.where(trace == 0, 1.0, np.abs(trace)), smallest
        )


@lru_cache(maxsize=64)
def feasible_set(
    parameters: tuple[str, ...], bodies: tuple[Body, ...], signed: tuple[str, ...] | None = None
) -> FeasibleSet:
    """Feasible set of a robot, cached."""
    return FeasibleSet(parameters, bodies, signed)


def feasible_set_of(problem: Problem) -> FeasibleSet:
    """Feasible set of a problem's parameters."""
    return feasible_set(problem.parameters, problem.bodies, problem.signed)
