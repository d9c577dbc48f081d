"""Joints that constraints hold together: some of them move, the others follow.

With the closure J v = 0 split in dependent and independent columns, v_dep = F v_ind with
F = -J_dep^+ J_ind, and a_dep = F a_ind - J_dep^+ (dJ/dt v). Rows may be redundant (a planar loop
closed in space): only the dependent columns have to be independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.models.coupling.constraints import Constraint
from sysid_bench.types import Array

SINGULAR: Final = 1e-3
"""Smallest singular value of the scaled J_dep (its entries are of order one at the reference) below
which a closure counts as singular: G would grow beyond all use."""

CLOSED: Final = 1e-4
"""Residual (rad, m) up to which a closure is found. Rounding leaves 1e-16; rounded lengths in a
model file leave a redundant row open by about as much as they are wrong."""

STEP: Final = 0.1
"""Independent joints go from the reference to a target in steps of this (rad; slides likewise, in
the loop's own length): small enough for Newton's method to stay on its branch."""

ITERATIONS: Final = 4
"""Newton steps at the end: 1e-2, 1e-4, 1e-8, 1e-16."""

PATIENT: Final = 30
"""Newton steps where the start may be far from closed."""


@dataclass(frozen=True, eq=False)
class SolverState:
    """What postures on a way have to keep: a smallest singular value, and limits (k,)."""

    regularity: float
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Group:
    """Constraints on the degrees of freedom `dofs` (k,); `dependent` (r,) and `independent` are
    places in them, `reference` (k,) a closed posture, `units` (k,) what scales a coordinate,
    `row_units` (m,) what scales a row."""

    constraints: tuple[Constraint, ...]
    dofs: Array
    dependent: Array
    independent: Array
    reference: Array
    units: Array
    row_units: Array

    @cached_property
    def linear(self) -> bool:
        """Whether F is the same everywhere."""
        return all(constraint.linear for constraint in self.constraints)

    def follow(self, x: Array) -> Array:
        """F (N, r, k - r) at closed x (N, k); one for all (1, r, k - r) where it is constant."""
        return self._followed(self._jacobian(x[:1] if self.linear else x))

    def drift(self, x: Array, v: Array) -> Array:
        """What the dependent joints accelerate (N, r) when the independent ones do not."""
        if self.linear:
            return np.zeros((len(x), len(self.dependent)))
        bias = np.concatenate(
            [c.drift(x[:, at], v[:, at]) for c, at in _located(self.constraints, self.dofs)], axis=1
        )
        return self._resolved(self._jacobian(x), -bias[:, :, None])[:, :, 0]

    def condition(self, x: Array) -> Array:
        """Smallest singular value (N,) of the scaled J_dep; infinite where nothing depends."""
        return self._regularity(self._jacobian(x))

    def _regularity(self, J: Array) -> Array:
        if len(self.dependent) == 0:
            return np.full(len(J), np.inf)
        D = self._scaled(J)[:, :, self.dependent]
        return np.sqrt(np.maximum(np.linalg.eigvalsh(D.swapaxes(1, 2) @ D)[:, 0], 0.0))

    def scaled_jacobian(self, x: Array) -> Array:
        """J (N, m, k) with its rows and columns scaled to entries of order one."""
        return self._scaled(self._jacobian(x))

    def _scaled(self, J: Array) -> Array:
        return J * self.units / self.row_units[:, None]

    def solve_closure(self, x: Array) -> Array | None:
        """The closed posture (k,) with the independent joints of x; None where none is near."""
        found, _, good = self._newton(x[None], PATIENT)
        return found[0] if good[0] and np.isfinite(found).all() else None

    def least_squares_step(self, x: Array) -> Array:
        """x (N, k) closed by the smallest moves of all its joints together."""
        x = x.copy()
        for _ in range(PATIENT):
            r, J = self._equation(x)
            moves = np.linalg.pinv(J * self.units, rcond=1e-6) @ r[:, :, None]
            x -= moves[:, :, 0] * self.units
        return x

    def residual_rank(self, x: Array, moves: Array) -> Array:
        """Closed postures a small way from closed x (N, k), moves (N, k - r) of the independent
        joints away."""
        x = x.copy()
        x[:, self.dependent] += _times(self.follow(x), moves)
        x[:, self.independent] += moves
        return self._newton(x, 2)[0]

    def is_closed(self, independent: Array, near: Array | None = None) -> tuple[Array, Array]:
        """Closed x (N, k) with these independent joints (N, k - r), on the branch of the reference,
        and which of them (N,) are closed and regular; `near` (N, k): closed postures of the same
        branch from where the way is shorter."""
        if self.linear:
            return self._closed_at_once(independent), np.ones(len(independent), dtype=bool)
        if near is not None:
            x, share = self.continuation(independent, start=near)
            return x, share == 1.0
        stride = self._stride(independent)
        start, share = self.continuation(independent[::stride])
        regular = share == 1.0
        x = np.repeat(start, stride, axis=0)[: len(independent)]
        regular = np.repeat(regular, stride)[: len(independent)]
        if stride > 1:
            at, moved = self.independent, independent - x[:, self.independent]
            before = self._jacobian(x)
            x[:, self.dependent] += _times(self._followed(before), moved)
            x[:, at] = independent
            x, J, found = self._newton(x, ITERATIONS)
            regular = regular & found & self._same_branch(before, J)
        return x, regular

    def continuation(
        self,
        targets: Array,
        keep: SolverState | None = None,
        least: int = 1,
        start: Array | None = None,
    ) -> tuple[Array, Array]:
        """`closed` for targets (N, k - r) that may lie far apart: each is walked to from the
        reference, or from closed postures `start` (N, k), in `least` steps or more. x (N, k) of the
        last place where the closure holds, and `keep` is kept, and its share (N,) of the way: 1 at
        the target."""
        x = np.tile(self.reference, (len(targets), 1)) if start is None else start
        J, begin = self._jacobian(x), x[:, self.independent]
        stretch = targets - begin
        far = np.abs(stretch / self.units[self.independent]).max(initial=0.0)
        count = max(least, int(np.ceil(far / STEP)))
        share, good = np.zeros(len(targets)), np.ones(len(targets), dtype=bool)
        for k in range(count):
            ahead = x.copy()
            ahead[:, self.dependent] += _times(self._followed(J), stretch) / count
            part = (k + 1) / count
            ahead[:, self.independent] = begin + part * stretch
            before = J
            ahead, J, found = self._newton(ahead, ITERATIONS if k == count - 1 else 2)
            jump = np.abs((ahead - x) / self.units).max(axis=1, initial=0.0)
            good = good & found & (jump < 1.0) & self._same_branch(before, J)
            if keep is not None:
                good = good & (self._regularity(J) >= keep.regularity)
                good = good & ((ahead >= keep.low) & (ahead <= keep.high)).all(axis=1)
            x, share = np.where(good[:, None], ahead, x), np.where(good, part, share)
        return x, share

    def _newton(self, x: Array, iterations: int) -> tuple[Array, Array, Array]:
        """Dependent joints moved until the constraints hold; J there; whether (N,) they do."""
        x = x.copy()
        for _ in range(iterations):
            r, J = self._equation(x)
            moves, most = self._resolved(J, r[:, :, None])[:, :, 0], self.units[self.dependent]
            x[:, self.dependent] -= np.clip(moves, -most, most)  # a lost closure stays finite
        r, J = self._equation(x)
        return x, J, np.abs(r).max(axis=1, initial=0.0) <= CLOSED

    def _same_branch(self, before: Array, after: Array) -> Array:
        """Whether (N,) J is regular, and was on the way from one place to the other: where a
        singular posture lies between the two, one direction of J_dep has changed its sign."""
        D, E = (self._scaled(J)[:, :, self.dependent] for J in (before, after))
        kept = np.linalg.det(D.swapaxes(1, 2) @ E) > 0.0
        return kept & (self._regularity(after) >= SINGULAR)

    def _followed(self, J: Array) -> Array:
        return self._resolved(J, -J[:, :, self.independent])

    def _closed_at_once(self, independent: Array) -> Array:
        x = np.tile(self.reference, (len(independent), 1))
        F = self.follow(x[:1])[0]
        x[:, self.dependent] += (independent - x[:, self.independent]) @ F.T
        x[:, self.independent] = independent
        return x

    def _stride(self, independent: Array) -> int:
        """How many samples of a motion may start from one that is closed already."""
        moves = np.abs(np.diff(independent, axis=0) / self.units[self.independent])
        fastest = float(moves.max(initial=0.0))
        return max(1, min(64, int(STEP / fastest))) if fastest > 0 else max(1, len(independent))

    def _equation(self, x: Array) -> tuple[Array, Array]:
        return equation(self.constraints, self.dofs, x)

    def _jacobian(self, x: Array) -> Array:
        return self._equation(x)[1]

    def _resolved(self, J: Array, rows: Array) -> Array:
        """J_dep^+ rows (N, r, c) for rows (N, m, c); once refined, since the normal equations
        square the condition number."""
        D = J[:, :, self.dependent]
        T = D.swapaxes(1, 2)
        normal = T @ D
        r = normal.shape[1]
        # Keeps the solver from stopping at a singular sample, which is sorted out afterwards.
        trace = np.trace(normal, axis1=1, axis2=2)
        normal = normal + (1e-14 * trace + 1e-300)[:, None, None] * np.eye(r)
        out = np.linalg.solve(normal, T @ rows)
        return out + np.linalg.solve(normal, T @ (rows - D @ out))


def equation(constraints: Sequence[Constraint], dofs: Array, x: Array) -> tuple[Array, Array]:
    """r (N, m) and J (N, m, k) of all constraints at x (N, k)."""
    values, slopes = [], []
    for constraint, at in _located(constraints, dofs):
        r, own = constraint.equation(x[:, at])
        J = np.zeros((*r.shape, len(dofs)))
        J[:, :, at] = own
        values.append(r)
        slopes.append(J)
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def _located(constraints: Sequence[Constraint], dofs: Array) -> list[tuple[Constraint, Array]]:
    return [(c, np.searchsorted(dofs, np.array(c.dofs))) for c in constraints]


def _times(F: Array, v: Array) -> Array:
    """F v (N, r) for F (N, r, c) and v (N, c)."""
    return np.matmul(F, v[:, :, None])[:, :, 0]
