"""Group of coupled joints: dependent ones follow independent ones through closure equations.

With the closure J v = 0 split in dependent and independent columns, v_dep = F v_ind with
F = -J_dep^+ J_ind, and a_dep = F a_ind - J_dep^+ (dJ/dt v). Rows may be redundant (a planar loop
closed in space): only the dependent columns must have full rank.
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
which a closure counts as singular: G would grow without bound."""

CLOSED: Final = 1e-4
"""Largest residual (rad, m) of a closed posture. Rounding leaves 1e-16; rounded lengths in a model
file leave redundant rows open by about the error of these lengths."""

STEP: Final = 0.1
"""Largest step (rad; slides in units of the loop's length) from the reference to a target: small
enough for Newton's method to stay on its branch."""

FINER_STEPS: Final = (48, 240)
"""Numbers of steps that are tried where a target is not reached in steps of STEP."""

ITERATIONS: Final = 4
"""Newton steps at the target; quadratic convergence: 1e-2, 1e-4, 1e-8, 1e-16."""

PATIENT: Final = 30
"""Newton steps where the start may be far from a closed posture."""


@dataclass(frozen=True, eq=False)
class ClosureLimits:
    """Bounds that postures must keep: a smallest singular value, and limits (k,)."""

    regularity: float
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Group:
    """Constraints on the degrees of freedom `dofs` (k,); `dependent` (r,) and `independent` are
    indices in them, `reference` (k,) a closed posture, `units` (k,) and `row_units` (m,) the scales
    of coordinates and rows."""

    constraints: tuple[Constraint, ...]
    dofs: Array
    dependent: Array
    independent: Array
    reference: Array
    units: Array
    row_units: Array

    @cached_property
    def linear(self) -> bool:
        """True where F is constant."""
        return all(constraint.linear for constraint in self.constraints)

    def follow(self, x: Array) -> Array:
        """Return F (N, r, k - r) at closed x (N, k); (1, r, k - r) where it is constant."""
        return self._followed(self._jacobian(x[:1] if self.linear else x))

    def drift(self, x: Array, v: Array) -> Array:
        """Return -J_dep^+ (dJ/dt v) (N, r): the dependent acceleration at constant independent
        rates."""
        if self.linear:
            return np.zeros((len(x), len(self.dependent)))
        columns = [np.searchsorted(self.dofs, np.array(c.dofs)) for c in self.constraints]
        parts = zip(self.constraints, columns, strict=True)
        bias = np.concatenate([c.drift(x[:, i], v[:, i]) for c, i in parts], axis=1)
        acceleration: Array = self._resolved(self._jacobian(x), -bias[:, :, None])[:, :, 0]
        return acceleration

    def condition(self, x: Array) -> Array:
        """Return the smallest singular value (N,) of the scaled J_dep; infinite without dependent
        dofs."""
        return self._regularity(self._jacobian(x))

    def closure_error(self, x: Array) -> Array:
        """Return the largest scaled residual of the rows at x that no move of the dependent joints
        reduces, over the smallest singular value (N,): the relative error of joint positions where
        redundant rows contradict each other. An x that is not closed adds nothing to first order,
        and there is none without redundant rows."""
        r, J = self._equation(x)
        if J.shape[1] == len(self.dependent):
            return np.zeros(len(x))
        residual = (r / self.row_units)[:, :, None]
        basis, _ = np.linalg.qr(self._scaled(J)[:, :, self.dependent])
        left = residual - basis @ (basis.swapaxes(1, 2) @ residual)
        error: Array = np.abs(left).max(axis=(1, 2), initial=0.0) / self._regularity(J)
        return error

    def _regularity(self, J: Array) -> Array:
        if len(self.dependent) == 0:
            return np.full(len(J), np.inf)
        # Eigenvalues of D' D are the squared singular values of D; faster in batches than an SVD.
        D = self._scaled(J)[:, :, self.dependent]
        squares = np.linalg.eigvalsh(D.swapaxes(1, 2) @ D)[:, 0]
        least: Array = np.sqrt(np.maximum(squares, 0.0))
        return least

    def scaled_jacobian(self, x: Array) -> Array:
        """Return J (N, m, k) with rows and columns scaled to entries of order one."""
        return self._scaled(self._jacobian(x))

    def _scaled(self, J: Array) -> Array:
        scaled: Array = J * self.units / self.row_units[:, None]
        return scaled

    def default_closure(self, x: Array) -> Array | None:
        """Return the closed posture (k,) with the independent joints of x; None where none is
        near."""
        found, _, good = self._newton(x[None], PATIENT)
        return found[0] if good[0] and np.isfinite(found).all() else None

    def nearest_closure(self, x: Array) -> Array:
        """Return x (N, k) closed by the smallest moves of all joints, the independent ones
        included."""
        x = x.copy()
        for _ in range(PATIENT):
            r, J = self._equation(x)
            # The pseudo-inverse drops directions in which the closure is singular.
            moves = np.linalg.pinv(J * self.units, rcond=1e-6) @ r[:, :, None]
            x -= moves[:, :, 0] * self.units
        return x

    def step_closure(self, x: Array, moves: Array) -> Array:
        """Return postures (N, k) closed again after small moves (N, k - r) of the independent
        joints from closed x (N, k)."""
        x = x.copy()
        x[:, self.dependent] += times(self.follow(x), moves)
        x[:, self.independent] += moves
        return self._newton(x, 2)[0]

    def motion_closure(self, independent: Array, near: Array | None = None) -> tuple[Array, Array]:
        """Return x (N, k) with these independent joints (N, k - r), on the branch of the reference,
        and True (N,) where x is closed and regular; `near` (N, k): closed postures of the same
        branch to start from."""
        if self.linear:
            x = np.tile(self.reference, (len(independent), 1))
            F = self.follow(x[:1])[0]
            x[:, self.dependent] += (independent - x[:, self.independent]) @ F.T
            x[:, self.independent] = independent
            return x, np.ones(len(independent), dtype=bool)
        if near is not None:
            x, share = self.follow_closure(independent, start=near)
            return x, share == 1.0
        # Neighbouring samples start from one posture of every `stride`, which is followed from the
        # reference: all samples are then solved at once.
        moves = np.abs(np.diff(independent, axis=0) / self.units[self.independent])
        fastest = float(moves.max(initial=0.0))
        stride = max(1, min(64, int(STEP / fastest))) if fastest > 0 else max(1, len(independent))
        start, share = self.follow_closure(independent[::stride])
        for steps in FINER_STEPS:
            # Shorter steps where the usual ones lose a fast dependent joint.
            lost = share < 1.0
            if lost.any():
                aims = independent[::stride][lost]
                start[lost], share[lost] = self.follow_closure(aims, least=steps)
        regular = share == 1.0
        x = np.repeat(start, stride, axis=0)[: len(independent)]
        regular = np.repeat(regular, stride)[: len(independent)]
        if stride > 1:
            moved = independent - x[:, self.independent]
            before = self._jacobian(x)
            x[:, self.dependent] += times(self._followed(before), moved)
            x[:, self.independent] = independent
            x, J, found = self._newton(x, ITERATIONS)
            regular = regular & found & self._same_branch(before, J)
        return x, regular

    def follow_closure(
        self,
        targets: Array,
        keep: ClosureLimits | None = None,
        least: int = 1,
        start: Array | None = None,
    ) -> tuple[Array, Array]:
        """Follow the closure to targets (N, k - r) that may lie far apart, each from the reference
        or from closed postures `start` (N, k), in `least` steps or more. Return x (N, k) of the
        last posture that is closed and within the bounds `keep`, and its share (N,) of the way: 1
        at the target."""
        x = np.tile(self.reference, (len(targets), 1)) if start is None else start
        J, begin = self._jacobian(x), x[:, self.independent]
        stretch = targets - begin
        far = np.abs(stretch / self.units[self.independent]).max(initial=0.0)
        count = max(least, int(np.ceil(far / STEP)))
        share, good = np.zeros(len(targets)), np.ones(len(targets), dtype=bool)
        for k in range(count):
            ahead = x.copy()
            ahead[:, self.dependent] += times(self._followed(J), stretch) / count
            part = (k + 1) / count
            ahead[:, self.independent] = begin + part * stretch
            before = J
            ahead, J, found = self._newton(ahead, ITERATIONS if k == count - 1 else 2)
            # Newton's method that lands far away has found another way to assemble the loop.
            jump = np.abs((ahead - x) / self.units).max(axis=1, initial=0.0)
            good = good & found & (jump < 1.0) & self._same_branch(before, J)
            if keep is not None:
                good = good & (self._regularity(J) >= keep.regularity)
                good = good & ((ahead >= keep.low) & (ahead <= keep.high)).all(axis=1)
            x, share = np.where(good[:, None], ahead, x), np.where(good, part, share)
        return x, share

    def _newton(self, x: Array, iterations: int) -> tuple[Array, Array, Array]:
        """Newton steps of the dependent joints; x, J there, and True (N,) where it is closed."""
        x = x.copy()
        for _ in range(iterations):
            r, J = self._equation(x)
            moves, most = self._resolved(J, r[:, :, None])[:, :, 0], self.units[self.dependent]
            x[:, self.dependent] -= np.clip(moves, -most, most)  # a lost closure stays finite
        r, J = self._equation(x)
        return x, J, np.abs(r).max(axis=1, initial=0.0) <= CLOSED

    def _same_branch(self, before: Array, after: Array) -> Array:
        """True (N,) where J is regular and no singular posture lies between two postures: beyond
        one, a direction of J_dep has changed its sign."""
        D, E = (self._scaled(J)[:, :, self.dependent] for J in (before, after))
        # D' E is close to D' D > 0 for neighbours; its determinant changes sign with J_dep.
        kept: Array = np.linalg.det(D.swapaxes(1, 2) @ E) > 0.0
        return kept & (self._regularity(after) >= SINGULAR)

    def _followed(self, J: Array) -> Array:
        return self._resolved(J, -J[:, :, self.independent])

    def _jacobian(self, x: Array) -> Array:
        return self._equation(x)[1]

    def _equation(self, x: Array) -> tuple[Array, Array]:
        return residual_jacobian(self.constraints, self.dofs, x)

    def _resolved(self, J: Array, rows: Array) -> Array:
        """J_dep^+ rows (N, r, c) for rows (N, m, c); refined once, since the normal equations
        square the condition number."""
        D = J[:, :, self.dependent]
        T = D.swapaxes(1, 2)
        normal = T @ D
        r = normal.shape[1]
        # Keeps np.linalg.solve from raising at a singular sample, which is discarded afterwards.
        trace = np.trace(normal, axis1=1, axis2=2)
        normal = normal + (1e-14 * trace + 1e-300)[:, None, None] * np.eye(r)
        out = np.linalg.solve(normal, T @ rows)
        refined: Array = out + np.linalg.solve(normal, T @ (rows - D @ out))
        return refined


def residual_jacobian(
    constraints: Sequence[Constraint], dofs: Array, x: Array
) -> tuple[Array, Array]:
    """Return r (N, m) and J (N, m, k) of all constraints at x (N, k)."""
    values, slopes = [], []
    for constraint in constraints:
        columns = np.searchsorted(dofs, np.array(constraint.dofs))
        r, part = constraint.residual_jacobian(x[:, columns])
        J = np.zeros((*r.shape, x.shape[1]))
        J[:, :, columns] = part
        values.append(r)
        slopes.append(J)
    return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)


def times(F: Array, v: Array) -> Array:
    """Return F v (N, r) for F (N or 1, r, c) and v (N, c)."""
    product: Array = np.matmul(F, v[:, :, None])[:, :, 0]
    return product


REGULAR: Final = 0.2
"""Least smallest singular value of a posture, as a share of that at the reference."""

STEPS: Final = 48
"""Least number of postures that are tried between the reference and a limit."""

INSIDE: Final = 0.95
"""Share of the way to the last good posture that is used: it may end between two that are tried."""

SCATTERED: Final = 64
"""Number of random postures that are tried in the box of independent joints."""

_ROUNDING: Final = 1e-9


def closure_limits(group: Group, low: Array, high: Array) -> tuple[Array, Array]:
    """Return lowest and highest displacements (k - r,) of the independent joints; `low`, `high`
    (k,) bound the displacements of all joints of the group, infinite where there is no limit."""
    moving = group.independent
    start, bounds = group.reference[moving], np.stack([low[moving], high[moving]])
    # Motions start at the reference even where it lies outside its limits.
    keep_low, keep_high = np.full(len(low), -np.inf), np.full(len(low), np.inf)
    follow = group.dependent
    keep_low[follow] = np.minimum(low[follow] - _ROUNDING, group.reference[follow])
    keep_high[follow] = np.maximum(high[follow] + _ROUNDING, group.reference[follow])
    margin = max(SINGULAR, REGULAR * float(group.condition(group.reference[None])[0]))
    keep = ClosureLimits(margin, keep_low, keep_high)
    # Each joint alone first, the others at the reference: one target per joint and side.
    sides = np.tile(start, (2, len(moving), 1))
    sides[:, np.arange(len(moving)), np.arange(len(moving))] = bounds
    shares = _shares(group, sides.reshape(-1, len(moving)), keep)
    bounds = start + shares.reshape(bounds.shape) * (bounds - start)
    # Then all together: the box shrinks as a whole until no way to its surface leaves the bounds.
    if len(moving) > 1:
        # Points (M, n) on its faces: random ones and, for n <= 6, corners; scaled to the largest
        # entry, which takes them from inside the box onto its faces.
        n, (below, above) = len(moving), bounds - start
        points = np.random.default_rng(0).uniform(-1.0, 1.0, (SCATTERED, n))
        points /= np.abs(points).max(axis=1, keepdims=True)
        if n <= 6:
            corners = 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1) - 1.0
            points = np.concatenate([corners, points])
        surface = start + np.where(points < 0, -points * below, points * above)
        bounds = start + _shares(group, surface, keep).min() * (bounds - start)
    return bounds[0], bounds[1]


def largest_jacobian(group: Group, low: Array, high: Array) -> Array:
    """Return the largest |F| (r, k - r) over postures within low and high (k - r,)."""
    # A fixed seed: limits belong to the model and are the same in every run.
    points = np.random.default_rng(0).uniform(size=(SCATTERED, len(low)))
    x, _ = group.follow_closure(np.concatenate([low + points * (high - low), [low, high]]))
    largest: Array = np.abs(group.follow(x)).max(axis=0)
    return largest


def _shares(group: Group, targets: Array, keep: ClosureLimits) -> Array:
    """Share (M,) of the way from the reference to each target along which all bounds hold."""
    if group.linear:
        # The same in closed form: linear followers meet their limits on straight lines.
        follow, start = group.dependent, group.reference
        # Displacement of each follower over the whole way, and how much of it its limits allow.
        moves = (targets - start[group.independent]) @ group.follow(start[None])[0].T
        allowed = np.where(moves > 0, keep.high[follow], keep.low[follow]) - start[follow]
        shares = np.full(moves.shape, 1.0)
        np.divide(allowed, moves, out=shares, where=np.abs(moves) > np.abs(allowed))
        least: Array = np.clip(shares, 0.0, 1.0).min(axis=1, initial=1.0)
        return least
    _, shares = group.follow_closure(targets, keep, STEPS)
    return np.where(shares < 1.0, INSIDE * shares, 1.0)
