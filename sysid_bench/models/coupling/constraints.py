"""Constraints that couple joints: polynomials of sums of joint positions, and closed chains.

Both are equations r(x) = 0 in the displacements x of some hinges and slides from their reference,
with the Jacobian J = dr/dx and the drift dJ/dt v.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from sysid_bench.models.coupling.joint_chain import Chain
from sysid_bench.types import Array


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
