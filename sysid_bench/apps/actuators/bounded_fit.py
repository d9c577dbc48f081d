"""Bounded least squares of actuators: armature and friction are not negative, joint by joint.

Deviations come from the residuals of blocks of the recording, whose correlation and unequal size
they hold (Carlstein, Annals of Statistics 14(3), 1986).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import chain, combinations
from typing import Final

import numpy as np

from sysid_bench.apps.actuators.drive_rows import DriveRows
from sysid_bench.types import Array

SIGNED: Final = 3
"""Unknowns that are not negative: the first of UNKNOWNS."""

BLOCK: Final = 0.5
"""s; residuals of neighbouring blocks count as independent."""

BLOCKS: Final = 8
"""Least number of blocks, of shorter recordings."""


@dataclass(frozen=True, eq=False)
class Group:
    """Joints (indices) that share armature and friction; each has its own offset. `A` (m n, 3 + m)
    holds the rows of its m joints below one another. Of `more` unknowns they share the load's
    friction, behind the third column, and the gain, behind that; each has its own bias, at last.
    `armature` (2, m): values of tables of motors and their deviations (None: of none of them)."""

    joints: tuple[int, ...]
    A: Array
    more: tuple[str, ...] = ()
    armature: Array | None = None

    @property
    def nonnegative(self) -> int:
        """Number of unknowns that are not negative, the first ones."""
        return SIGNED + ("load" in self.more)

    def columns(self, i: int) -> list[int]:
        """Return the columns of the i-th joint's unknowns: those of UNKNOWNS, then `more`."""
        shared = [name for name in self.more if name != "bias"]
        own = SIGNED + len(shared) + i
        further = [
            own + len(self.joints) if name == "bias" else SIGNED + shared.index(name)
            for name in self.more
        ]
        return [*range(SIGNED), own, *further]

    @property
    def samples(self) -> int:
        """Samples n of each joint."""
        return len(self.A) // len(self.joints)

    @cached_property
    def factors(self) -> tuple[Array, Array]:
        """Q (m n, 3 + m) and R (3 + m, 3 + m) of A = Q R, which serve all delays."""
        # A delay changes b alone: one factorisation serves the whole profile.
        Q, R = np.linalg.qr(self.A)
        return Q, R

    def prior(self, scale: Array | None) -> tuple[Array, Array, Array]:
        """Return rows P (m, c), p (m,) of the armature's prior with their deviations (m,), those of
        `scale` (k,) of its joints; none without a scale."""
        columns = self.A.shape[1]
        if scale is None or self.armature is None:
            return np.zeros((0, columns)), np.zeros(0), np.zeros(0)
        value, std = self.armature
        known = np.isfinite(value)
        own = scale[list(self.joints)][known]
        # A prior row has the deviation of a row of data, so that both weigh as they are certain.
        P = np.zeros((len(own), columns))
        P[:, 0] = own / std[known]
        return P, P[:, 0] * value[known], own

    def prior_cost(self, armature: float) -> float:
        """Return the squared distances of an armature to those of tables, in their deviations."""
        if self.armature is None:
            return 0.0
        value, std = self.armature
        return float(np.nansum(((armature - value) / std) ** 2))


@dataclass(frozen=True, eq=False)
class Fit:
    """Values (k, 4) in the order of UNKNOWNS, their deviations, which of them lie on the bound of
    zero, and residuals (N, k); values and deviations (k, e) of `more` unknowns, the factors
    (k, 4 + e) of all columns, and the covariance (k, 4 + e, 4 + e) of each joint's values.
    `penalty`: sum of the squared distances to the armatures of tables, in their deviations."""

    values: Array
    std: Array
    at_bound: Array
    residuals: Array
    more: Array
    more_std: Array
    factors: Array
    covariance: Array
    penalty: float = 0.0

    @property
    def errors(self) -> Array:
        """RMS residuals (k,)."""
        return np.asarray(np.sqrt(np.mean(self.residuals**2, axis=0)))


def group_joints(rows: DriveRows, shared: Sequence[str]) -> tuple[Group, ...]:
    """Return the groups of joints: those whose names hold the same word of `shared`, or match the
    same pattern ("*_knee"), and each other joint by itself."""
    # The first word that a name holds decides: a joint is in one group.
    labels = [next((w for w in shared if holds(name, w)), name) for name in rows.joints]
    members = [
        tuple(i for i, label in enumerate(labels) if label == one) for one in dict.fromkeys(labels)
    ]
    groups = []
    for joints in members:
        armature = None if rows.armature is None else rows.armature[:, joints]
        groups.append(Group(joints, _stacked(rows, joints), rows.more, armature))
    return tuple(groups)


def holds(name: str, word: str) -> bool:
    """Test whether a name holds a word, or matches a pattern with * or ?."""
    return fnmatchcase(name, word) if set(word) & set("*?[") else word in name


def _stacked(rows: DriveRows, joints: tuple[int, ...]) -> Array:
    """Return the rows of some joints below one another, each with its own constant."""
    own, first = np.eye(len(joints)), SIGNED + 1
    shared = [first + rows.more.index(name) for name in rows.more if name != "bias"]
    parts = []
    for i, j in enumerate(joints):
        columns = [rows.features[:, j][:, [*range(SIGNED), *shared]]]
        columns.append(np.tile(own[i], (len(rows.features), 1)))
        if "bias" in rows.more:
            columns.append(rows.features[:, j, [first + rows.more.index("bias")]] * own[i])
        parts.append(np.hstack(columns))
    return np.concatenate(parts)


def bounded_fit(
    groups: Sequence[Group], tau: Array, rate: float, scale: Array | None = None
) -> Fit:
    """Return the fit of torques tau (N, k) at a rate (Hz). `scale` (k,): deviation of a row of each
    joint that would be independent of the others, beside which armatures of tables weigh; None:
    these are left out."""
    count = SIGNED + 1 + len(groups[0].more)
    values, factors = np.zeros((2, tau.shape[1], count))
    covariances = np.zeros((tau.shape[1], count, count))
    residuals, penalty = np.empty_like(tau), 0.0
    for group in groups:
        b = tau[:, group.joints].T.ravel()
        Q, R = group.factors
        P, p, _ = group.prior(scale)
        # |R x - Q'b| and |A x - b| have one minimum.
        x, free = solve_bounded(
            np.concatenate([R, P]), np.concatenate([Q.T @ b, p]), group.nonnegative
        )
        r = b - group.A @ x
        covariance = _covariance(group, r, free, rate, scale)
        penalty += group.prior_cost(x[0]) if len(p) else 0.0
        for i, j in enumerate(group.joints):
            own = group.columns(i)
            factors[j] = x[own]
            values[j], covariances[j] = _physical(x[own], covariance[np.ix_(own, own)], group.more)
            residuals[:, j] = r[i * group.samples : (i + 1) * group.samples]
    # The offset has either sign: zero does not bound it.
    at_bound = (values[:, : SIGNED + 1] == 0.0) & (np.arange(SIGNED + 1) != SIGNED)
    std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    (own_values, more), (own_std, more_std) = (
        np.split(x, [SIGNED + 1], axis=1) for x in (values, std)
    )
    return Fit(
        values=own_values,
        std=own_std,
        at_bound=at_bound,
        residuals=residuals,
        more=more,
        more_std=more_std,
        factors=factors,
        covariance=covariances,
        penalty=penalty,
    )


def _physical(x: Array, covariance: Array, more: Sequence[str]) -> tuple[Array, Array]:
    """Return values and their covariance for factors x (4 + e,): both sides were divided by the
    gain, so that its own factor is 1 / gain - 1."""
    # Delta method: `slopes` are the derivatives of the values by the factors.
    slopes, values = np.eye(len(x)), x.copy()
    # Commands without any torque leave the gain open: it is infinite, and all values with it.
    with np.errstate(divide="ignore", invalid="ignore"):
        if "gain" in more:
            g = SIGNED + 1 + more.index("gain")
            gain = np.divide(1.0, 1.0 + x[g])
            values, slopes = gain * x, gain * slopes
            slopes[:, g] -= gain * values
            values[g], slopes[g] = gain, 0.0
            slopes[g, g] = -(gain**2)
        return values, slopes @ covariance @ slopes.T


def solve_bounded(A: Array, b: Array, bounded: int = SIGNED) -> tuple[Array, Array]:
    """Return x (c,) of the least |A x - b| with its first `bounded` not negative, and the indices
    of those that are not on the bound.

    With three bounds all eight active sets are tried, so that the answer is exact.
    """
    count = A.shape[1]
    best, least, best_free = np.zeros(count), np.inf, np.arange(0)
    others = np.arange(bounded, count)
    sizes = range(bounded, -1, -1)  # the most unknowns off their bound first
    for signs in chain.from_iterable(combinations(range(bounded), size) for size in sizes):
        free = np.concatenate([np.array(signs, dtype=int), others])
        x = np.linalg.lstsq(A[:, free], b, rcond=None)[0]
        signed = x[free < bounded]
        # A set with negative values is not allowed.
        error = float(np.linalg.norm(A[:, free] @ x - b)) if (signed >= 0.0).all() else np.inf
        if error < least:
            least, best_free = error, free
            best = np.zeros(count)
            best[free] = x
    return best, best_free


def _covariance(group: Group, r: Array, free: Array, rate: float, scale: Array | None) -> Array:
    """Return the covariance (c, c) of the free unknowns, zero for those on a bound."""
    A, n = group.A[:, free], group.samples
    length = max(1, min(round(BLOCK * rate), n // BLOCKS))
    starts = np.arange(0, n, length)
    # Joints move together, so that a block holds the residuals of all of them.
    scores = (A * r[:, None]).reshape(len(group.joints), n, -1).sum(axis=0)
    sums = np.add.reduceat(scores, starts, axis=0)
    P, _, own = group.prior(scale)
    P = P[:, free]
    # Sandwich: the scatter of the scores between two inverses of the information, which holds
    # whatever correlation the residuals have within a block.
    inverse = np.linalg.pinv(A.T @ A + P.T @ P, hermitian=True)
    # A fit of c unknowns leaves the scatter of few blocks too small.
    few = len(starts) / max(1, len(starts) - len(free))
    of_prior = P * own[:, None]
    covariance = inverse @ (few * (sums.T @ sums) + of_prior.T @ of_prior) @ inverse
    whole = np.zeros((group.A.shape[1], group.A.shape[1]))
    whole[np.ix_(free, free)] = covariance
    return whole
