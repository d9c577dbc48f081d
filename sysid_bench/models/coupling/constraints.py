"""Constraints that couple joints: polynomials of sums of joint positions, and closed chains."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from sysid_bench.spatial import skew
from sysid_bench.types import Array


@dataclass(frozen=True, eq=False)
class ChainJoint:
    """One hinge or slide: its index among the coordinates, axis and anchor (3,) in its body."""

    index: int
    slide: bool
    axis: Array
    anchor: Array

    def rotation_matrix(self, angle: Array) -> Array:
        """Rotations (N, 3, 3) by `angle` (N,) about the axis, a unit vector (Rodrigues)."""
        along = np.outer(self.axis, self.axis)
        R: Array = along + (np.eye(3) - along) * np.cos(angle)[:, None, None]
        R += skew(self.axis) * np.sin(angle)[:, None, None]
        return R


@dataclass(frozen=True, eq=False)
class Step:
    """One body: its pose (p, R) in the parent, and the joints that move it, in order."""

    p: Array
    R: Array
    joints: tuple[ChainJoint, ...]


@dataclass(frozen=True, eq=False)
class Chain:
    """Bodies from the common one (excluded) to the last, and the frame (p, R) in the last."""

    steps: tuple[Step, ...]
    p: Array
    R: Array

    def evaluate(self, x: Array) -> "_ChainState":
        """Return the pose of the end with the joints displaced by x (N, k) from their reference."""
        N = len(x)
        R, p = np.tile(np.eye(3), (N, 1, 1)), np.zeros((N, 3))
        joints, axes, anchors = [], [], []
        for step in self.steps:
            R, p = R @ step.R, p + R @ step.p
            for joint in step.joints:
                axis = R @ joint.axis
                anchor = p + R @ joint.anchor
                displacement = x[:, joint.index]
                if joint.slide:
                    p = p + axis * displacement[:, None]
                else:
                    # The anchor stays in place while the body turns about it.
                    R = R @ joint.rotation_matrix(displacement)
                    p = anchor - R @ joint.anchor
                joints.append(joint)
                axes.append(axis)
                anchors.append(anchor)
        return _ChainState(p + R @ self.p, R @ self.R, tuple(joints), tuple(axes), tuple(anchors))


@dataclass(frozen=True, eq=False)
class _ChainState:
    """The end of a chain, p (N, 3) and R (N, 3, 3); axis and anchor (N, 3) of each joint."""

    p: Array
    R: Array
    joints: tuple[ChainJoint, ...]
    axes: tuple[Array, ...]
    anchors: tuple[Array, ...]

    def jacobian(self, k: int) -> Array:
        """Return the Jacobian J (N, 6, k) of the end's twist [w; v]."""
        J = np.zeros((len(self.p), 6, k))
        for joint, axis, anchor in zip(self.joints, self.axes, self.anchors, strict=True):
            if joint.slide:
                J[:, 3:, joint.index] = axis
            else:
                J[:, :3, joint.index] = axis
                J[:, 3:, joint.index] = _cross(axis, self.p - anchor)
        return J

    def drift(self, v: Array) -> Array:
        """Return the drift acceleration dJ/dt v (N, 6), [alpha; a] of the end at constant rates
        v."""
        w, out = np.zeros_like(self.p), np.zeros((len(self.p), 6))
        velocity = np.einsum("nij,nj->ni", self.jacobian(v.shape[1])[:, 3:], v)
        moves = list(zip(self.joints, self.axes, self.anchors, strict=True))
        for i, (joint, axis, anchor) in enumerate(moves):
            rate = v[:, joint.index, None]
            turning = _cross(w, axis)
            if joint.slide:
                out[:, 3:] += turning * rate
                continue
            # Velocity of the anchor, due to the joints before this one.
            carried = np.zeros_like(anchor)
            for before, direction, origin in moves[:i]:
                arm = direction if before.slide else _cross(direction, anchor - origin)
                carried += arm * v[:, before.index, None]
            # d/dt (axis x arm) = (w x axis) x arm + axis x (velocity of the end - of the anchor);
            # w turns the axis: it is the angular velocity of the bodies before the joint.
            out[:, :3] += turning * rate
            out[:, 3:] += _cross(turning, self.p - anchor) * rate
            out[:, 3:] += _cross(axis, velocity - carried) * rate
            w = w + axis * rate
        return out


def _cross(a: Array, b: Array) -> Array:
    """a x b of vectors (N, 3); np.cross is slower by its handling of axes."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


@dataclass(frozen=True, eq=False)
class PolynomialCoupling:
    """first . x = P(second . x), P by its coefficients in ascending order: an equality of two
    joints or two fixed tendons, or of one with a constant."""

    name: str
    dofs: tuple[int, ...]
    first: Array
    second: Array
    coefficients: Array

    @property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of successive rows that have the same unit."""
        return (1,)

    @property
    def linear(self) -> bool:
        """True where J is constant."""
        return not self.coefficients[2:].any()

    def residual_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return r (N, 1) and J (N, 1, k) at x (N, k)."""
        # J = first - P'(second . x) second
        slope = polynomial.polyval(x @ self.second, polynomial.polyder(self.coefficients))
        r = x @ self.first - polynomial.polyval(x @ self.second, self.coefficients)
        return r[:, None], (self.first - slope[:, None] * self.second)[:, None]

    def drift(self, x: Array, v: Array) -> Array:
        """Return dJ/dt v (N, 1) = -P''(second . x) (second . v)^2."""
        bend = polynomial.polyval(x @ self.second, polynomial.polyder(self.coefficients, 2))
        drift: Array = (-bend * (v @ self.second) ** 2)[:, None]
        return drift


@dataclass(frozen=True, eq=False)
class ChainClosure:
    """A closed chain: two serial chains from one body whose ends coincide, in position, and where
    `rigid` in orientation, too. Rows: difference of positions, then the rotation vector."""

    name: str
    dofs: tuple[int, ...]
    one: Chain
    other: Chain
    rigid: bool

    @property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of successive rows that have the same unit: m, then rad."""
        return (3, 3) if self.rigid else (3,)

    @property
    def linear(self) -> bool:
        """False: J depends on x, but in special cases, which are not looked for."""
        return False

    def residual_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return r (N, 3 or 6) and J (N, 3 or 6, k) at x (N, k); J is exact where the loop
        closes."""
        one, other = self.one.evaluate(x), self.other.evaluate(x)
        # Jacobians have rotation first, [w; v]; rows here have position first.
        J = one.jacobian(x.shape[1]) - other.jacobian(x.shape[1])
        r = one.p - other.p
        if not self.rigid:
            return r, J[:, 3:]
        # Half the sum of the cross products of the axes is sin(angle) times the rotation axis.
        P = other.R @ one.R.swapaxes(1, 2)
        turn = 0.5 * (P[:, [1, 2, 0], [2, 0, 1]] - P[:, [2, 0, 1], [1, 2, 0]])
        return np.concatenate([r, turn], axis=1), J[:, [3, 4, 5, 0, 1, 2]]

    def drift(self, x: Array, v: Array) -> Array:
        """Return dJ/dt v (N, 3 or 6)."""
        difference = self.one.evaluate(x).drift(v) - self.other.evaluate(x).drift(v)
        rows = [3, 4, 5, 0, 1, 2] if self.rigid else [3, 4, 5]
        drift: Array = difference[:, rows]
        return drift


Constraint = PolynomialCoupling | ChainClosure
