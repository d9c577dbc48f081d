"""Coordinates of mechanisms: each joint of a closed chain as scalars x, displacements from where it
is drawn.

A hinge or slide is one of them. A ball joint is three Cardan angles, its rotation from the
reference being Rx(x1) Ry(x2) Rz(x3), and a free joint three displacements in world axes before
them. Angular velocities w are in the body: w = B(x) dx/dt, singular where x2 is a right angle.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Protocol

import numpy as np

from sysid_bench.spatial import (
    composed_rotation,
    inverse_quaternion,
    matrix_of_quaternion,
    quaternion_of_rotation,
)
from sysid_bench.types import Array


class _RotatingJoint(Protocol):
    """Kind (free ball slide hinge) and addresses in q and v of a joint."""

    @property
    def kind(self) -> str: ...
    @property
    def qadr(self) -> int: ...
    @property
    def vadr(self) -> int: ...


REACH: Final = (0.5, 0.8)
"""m, rad: displacements of free and ball joints that motions may use, unless the closure allows
less."""

STEEP: Final = 1.3
"""rad; largest second Cardan angle that motions may use: cos(1.3) = 0.27 = det B."""


@dataclass(frozen=True, eq=False)
class Rotation:
    """A rotation in all directions: its first column among the coordinates, the address of its
    quaternion in q, and the quaternion of its reference (4,)."""

    column: int
    qadr: int
    q0: Array

    @property
    def columns(self) -> slice:
        """Its three columns."""
        return slice(self.column, self.column + 3)

    def read(self, q: Array) -> Array:
        """Return the Cardan angles (N, 3) at q (N, nq)."""
        turned = q[:, self.qadr : self.qadr + 4]
        unit = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        R = matrix_of_quaternion(composed_rotation(inverse_quaternion(self.q0), unit))
        first = np.arctan2(-R[:, 1, 2], R[:, 2, 2])
        second = np.arctan2(R[:, 0, 2], np.hypot(R[:, 0, 0], R[:, 0, 1]))
        third = np.arctan2(-R[:, 0, 1], R[:, 0, 0])
        return np.column_stack([first, second, third])

    def write(self, x: Array, q: Array) -> None:
        """Write the rotation at coordinates x (N, k) to q (N, nq)."""
        turned = np.tile(self.q0, (len(x), 1))
        for axis, angle in zip(np.eye(3), x[:, self.columns].T, strict=True):
            turned = composed_rotation(turned, quaternion_of_rotation(angle[:, None] * axis))
        q[:, self.qadr : self.qadr + 4] = turned

    def rate_matrix(self, x: Array) -> Array:
        """Return B (N, 3, 3) at coordinates x (N, k)."""
        _, (c2, c3), (s2, s3) = self._angles(x)
        zero, one = np.zeros(len(x)), np.ones(len(x))
        rows = [[c2 * c3, s3, zero], [-c2 * s3, c3, zero], [s2, zero, one]]
        return np.moveaxis(np.array(rows), -1, 0)

    def drift(self, x: Array, dx: Array) -> Array:
        """Return dB/dt dx (N, 3) at x and dx (N, k)."""
        _, (c2, c3), (s2, s3) = self._angles(x)
        d1, d2, d3 = dx[:, self.columns].T
        first = [-s2 * c3 * d2 - c2 * s3 * d3, s2 * s3 * d2 - c2 * c3 * d3, c2 * d2]
        second = [c3 * d3, -s3 * d3, np.zeros(len(x))]
        change = np.column_stack(first) * d1[:, None] + np.column_stack(second) * d2[:, None]
        return np.asarray(change)

    def _angles(self, x: Array) -> tuple[Array, Array, Array]:
        second_third = x[:, self.column + 1 : self.column + 3].T
        return second_third, np.cos(second_third), np.sin(second_third)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates x of some degrees of freedom: `addresses` (k,) in q (-1: of a rotation), their
    values `q0` (k,) in the reference, and `rotations`. True (k,) in `lengths` for metres, and in
    `driven` for hinges and slides, which alone may have motors and encoders."""

    addresses: Array
    q0: Array
    rotations: tuple[Rotation, ...]
    lengths: Array
    driven: Array

    @cached_property
    def _scalar(self) -> Array:
        return np.flatnonzero(self.addresses >= 0)

    def of(self, dofs: Array) -> "Coordinates":
        """Return those of sorted degrees of freedom `dofs`, which have all of a joint or none."""
        inside = [r for r in self.rotations if r.column in dofs]
        rotations = tuple(
            Rotation(int(np.searchsorted(dofs, r.column)), r.qadr, r.q0) for r in inside
        )
        return Coordinates(
            self.addresses[dofs], self.q0[dofs], rotations, self.lengths[dofs], self.driven[dofs]
        )

    def read(self, q: Array) -> Array:
        """Return x (N, k) at q (N, nq)."""
        x = np.zeros((len(q), len(self.addresses)))
        x[:, self._scalar] = q[:, self.addresses[self._scalar]] - self.q0[self._scalar]
        for rotation in self.rotations:
            x[:, rotation.columns] = rotation.read(q)
        return x

    def write(self, x: Array, q: Array) -> None:
        """Write coordinates x (N, k) to q (N, nq)."""
        q[:, self.addresses[self._scalar]] = x[:, self._scalar] + self.q0[self._scalar]
        for rotation in self.rotations:
            rotation.write(x, q)

    def rates(self, x: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return dx/dt and its derivative (N, k) for velocities and accelerations v, a (N, k)."""
        dx, ddx = v.copy(), a.copy()
        for rotation in self.rotations:
            part, B = rotation.columns, rotation.rate_matrix(x)
            dx[:, part] = np.linalg.solve(B, v[:, part, None])[:, :, 0]
            rest = a[:, part] - rotation.drift(x, dx)
            ddx[:, part] = np.linalg.solve(B, rest[:, :, None])[:, :, 0]
        return dx, ddx

    def velocity(self, x: Array, dx: Array, ddx: Array) -> tuple[Array, Array]:
        """Return v and a (N, k), the inverse of `rates`."""
        v, a = dx.copy(), ddx.copy()
        for rotation in self.rotations:
            part, B = rotation.columns, rotation.rate_matrix(x)
            v[:, part] = np.einsum("nij,nj->ni", B, dx[:, part])
            a[:, part] = np.einsum("nij,nj->ni", B, ddx[:, part]) + rotation.drift(x, dx)
        return v, a

    def rate_columns(self, x: Array, L: Array) -> Array:
        """Return V (N, k, c) with v = V u, for dx/dt = L u, L (N, k, c)."""
        V = np.array(np.broadcast_to(L, (len(x), *L.shape[1:])))
        for rotation in self.rotations:
            V[:, rotation.columns] = rotation.rate_matrix(x) @ V[:, rotation.columns]
        return V


def coordinates_of(joints: Iterable[_RotatingJoint], qpos0: Array, nv: int) -> Coordinates:
    """Return the coordinates of all degrees of freedom (nv,) of a tree; `qpos0` (nq,) is its
    reference."""
    addresses, q0, rotations = np.full(nv, -1), np.zeros(nv), []
    metres, driven = np.zeros((2, nv), dtype=bool)
    for joint in joints:
        # A free joint has a position before its rotation.
        count = {"ball": 0, "free": 3}.get(joint.kind, 1)
        dofs = np.arange(joint.vadr, joint.vadr + count)
        addresses[dofs] = joint.qadr + np.arange(count)
        q0[dofs] = qpos0[addresses[dofs]]
        metres[dofs] = joint.kind != "hinge"
        driven[dofs] = joint.kind != "free"
        if joint.kind in ("ball", "free"):
            qadr = joint.qadr + count
            rotations.append(Rotation(joint.vadr + count, qadr, np.array(qpos0[qadr : qadr + 4])))
    return Coordinates(addresses, q0, tuple(rotations), metres, driven)


def with_limits(coordinates: Coordinates, low: Array, high: Array) -> tuple[Array, Array]:
    """Return limits (nv,) of all coordinates from those of hinges and slides, infinite elsewhere:
    REACH for ball and free joints."""
    reach = np.where(coordinates.addresses >= 0, *REACH)
    return np.where(np.isinf(low), -reach, low), np.where(np.isinf(high), reach, high)


def with_rate_limits(coordinates: Coordinates, low: Array, high: Array) -> tuple[Array, Array]:
    """Return limits (nv,) within which the rates of all coordinates are determined."""
    low, high = low.copy(), high.copy()
    second = [rotation.column + 1 for rotation in coordinates.rotations]
    low[second], high[second] = -STEEP, STEEP
    return low, high
