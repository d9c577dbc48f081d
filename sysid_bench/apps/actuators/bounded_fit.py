"""Bounded least squares of actuators: armature and friction are not negative, joint by joint, nor
below a share of those of the model file.

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
from sysid_bench.evaluation.intervals import likelihood_drop
from sysid_bench.numerics import correlation_time
from sysid_bench.types import Array

SIGNED: Final = 3
"""Unknowns that are not negative: the first of UNKNOWNS."""

BLOCK: Final = 0.5
"""s; residuals of neighbouring blocks count as independent."""

SHARES: Final = (1.0, 0.3, 0.1, 0.01)
"""Of the least values: files may be wrong by any factor, and a drive is still not without them."""

MISFIT: Final = 0.05
"""Share of the residuals that decides nothing: most of them is misfit of the model, not noise."""

BLOCKS: Final = 8
"""Least number of blocks, of shorter recordings."""


@dataclass(frozen=True, eq=False)
class Group:
    """Joints (indices) that share armature and friction; each has its own offset. `A` (m n, 3 + m)
    holds the rows of its m joints below one another. Of `more` unknowns they share the load's
    friction, behind the third column; each has its own bias, at last. `armature` (2, m): values of
    tables of motors and their deviations (None: of none of them). `links` (m n,): torque of the
    links where the gain is unknown, `gain` its value and the deviation of 1 / gain, which
    `gain_profile` finds. `low` (3,): least armature and friction (None: zero)."""

    joints: tuple[int, ...]
    A: Array
    more: tuple[str, ...] = ()
    armature: Array | None = None
    links: Array | None = None
    gain: tuple[float, float] = (1.0, 0.0)
    low: Array | None = None

    @property
    def nonnegative(self) -> int:
        """Number of unknowns that are not negative, the first ones."""
        return SIGNED + ("load" in self.more)

    def columns(self, i: int) -> list[int]:
        """Return the columns of the i-th joint's unknowns: those of UNKNOWNS, then `more` but for
        the gain."""
        own = self.nonnegative + i
        of = {"load": SIGNED, "bias": own + len(self.joints)}
        return [*range(SIGNED), own, *(of[name] for name in self.more if name in of)]

    @property
    def samples(self) -> int:
        """Samples n of each joint."""
        return len(self.A) // len(self.joints)

    @property
    def lowest(self) -> Array:
        """Least values (c,) of the columns of A, over the gain, zero for those without a bound."""
        least = np.zeros(self.A.shape[1])
        least[:SIGNED] = 0.0 if self.low is None else self.low / self.gain[0]
        return least

    @cached_property
    def factors(self) -> tuple[Array, Array]:
        """Q (m n, 3 + m) and R (3 + m, 3 + m) of A = Q R, which serve all delays."""
        # A delay changes b alone: one factorisation serves the whole profile.
        Q, R = np.linalg.qr(self.A)
        return Q, R

    def loss(self, x: Array, b: Array, counts: Array) -> float:
        """Return twice the loss of log-likelihood of x (c,) for torques b (m n,) whose joints have
        `counts` (m,) independent samples, and residuals of an unknown scale each."""
        squares = ((b - self.A @ x).reshape(len(self.joints), -1) ** 2).mean(axis=1)
        return float(counts @ np.log(np.maximum(squares, 1e-24)))

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
    """Values (k, 4) in the order of UNKNOWNS, their deviations, which of them lie on their
    lower bound, and residuals (N, k); values and deviations (k, e) of `more` unknowns, the factors
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
        links = rows.links[:, joints].T.ravel() if "gain" in rows.more else None
        low = None if rows.low is None else rows.low[list(joints)].mean(axis=0)
        A = _stacked(rows, joints)
        groups.append(Group(joints, A, rows.more, armature, links, low=low))
    return tuple(groups)


def holds(name: str, word: str) -> bool:
    """Test whether a name holds a word, or matches a pattern with * or ?."""
    return fnmatchcase(name, word) if set(word) & set("*?[") else word in name


def _stacked(rows: DriveRows, joints: tuple[int, ...]) -> Array:
    """Return the rows of some joints below one another, each with its own constant."""
    own, first = np.eye(len(joints)), SIGNED + 1
    shared = [first + rows.more.index(name) for name in rows.more if name == "load"]
    parts = []
    for i, j in enumerate(joints):
        columns = [rows.features[:, j][:, [*range(SIGNED), *shared]]]
        columns.append(rows.features[:, j, [SIGNED]] * own[i])
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
    at_bound = np.zeros((tau.shape[1], SIGNED + 1), dtype=bool)
    for group in groups:
        b = tau[:, group.joints].T.ravel()
        if group.links is not None:
            b = b - (1.0 / group.gain[0] - 1.0) * group.links
        Q, R = group.factors
        P, p, _ = group.prior(scale)
        # |R x - Q'b| and |A x - b| have one minimum.
        x, free = _above_least(group, b, np.concatenate([R, P]), np.concatenate([Q.T @ b, p]), rate)
        r = b - group.A @ x
        covariance = block_covariance(group, r, free, rate, scale)
        penalty += group.prior_cost(x[0]) if len(p) else 0.0
        for i, j in enumerate(group.joints):
            own = group.columns(i)
            factors[j], whole = _with_gain(group, x[own], covariance[np.ix_(own, own)], own)
            values[j], covariances[j] = _physical(factors[j], whole, group.more)
            residuals[:, j] = r[i * group.samples : (i + 1) * group.samples]
            at_bound[j, :SIGNED] = ~np.isin(np.arange(SIGNED), free)
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


def _above_least(group: Group, b: Array, A: Array, a: Array, rate: float) -> tuple[Array, Array]:
    """Return x (c,) of the least |A x - a|, and the indices of those that are not on a bound: that
    of the group, or a smaller one where the residuals of its rows `b` decide against it."""
    x, free = solve_bounded(A, a, group.nonnegative)
    low = group.lowest
    if (x >= low)[:SIGNED].all():
        return x, free
    counts = independent_samples((b - group.A @ x).reshape(len(group.joints), -1).T, rate)
    least = group.loss(x, b, counts)
    for share in SHARES:
        moved, inner = solve_bounded(A, a - A @ (share * low), group.nonnegative)
        moved = moved + share * low
        allowed = max(likelihood_drop(), 2.0 * MISFIT * float(counts.sum()))
        if group.loss(moved, b, counts) - least <= allowed:
            return moved, inner
    return x, free


def _with_gain(
    group: Group, x: Array, covariance: Array, own: Sequence[int]
) -> tuple[Array, Array]:
    """Return the factors (4 + e,) of a joint and their covariance with 1 / gain - 1 among them."""
    if group.links is None:
        return x, covariance
    gain, std = group.gain
    place = SIGNED + 1 + group.more.index("gain")
    # What the others change by where the gain is another one.
    moved = -np.linalg.lstsq(group.A, group.links, rcond=None)[0][list(own)]
    moved[np.diagonal(covariance) == 0.0] = 0.0
    whole = np.insert(np.insert(covariance, place, 0.0, axis=0), place, 0.0, axis=1)
    slope = np.insert(moved, place, 1.0)
    return np.insert(x, place, 1.0 / gain - 1.0), whole + std**2 * np.outer(slope, slope)


def _physical(x: Array, covariance: Array, more: Sequence[str]) -> tuple[Array, Array]:
    """Return values and their covariance for factors x (4 + e,): both sides were divided by the
    gain, so that its own factor is 1 / gain - 1."""
    if "gain" not in more:
        return x, covariance
    # Delta method: `slopes` are the derivatives of the values by the factors.
    g = SIGNED + 1 + more.index("gain")
    gain = 1.0 / (1.0 + x[g])
    values, slopes = gain * x, gain * np.eye(len(x))
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


LAGS: Final = 0.5
"""s over which the correlation of residuals is summed."""


def independent_samples(residuals: Array, rate: float) -> Array:
    """Return the number (k,) of independent samples in residuals (N, k) at a rate (Hz): N over
    their correlation time, summed over LAGS or a quarter of the recording."""
    N = len(residuals)
    centred = residuals - residuals.mean(axis=0)
    longest = max(min(int(LAGS * rate), N // 4) - 1, 0)
    # Rows of a joint that sticks have a residual of zero, and count as none.
    counts = np.maximum(np.count_nonzero(residuals, axis=0), 1)
    return np.array([
        n / correlation_time(x, longest) for n, x in zip(counts, centred.T, strict=True)
    ])  # fmt: skip


def block_covariance(
    group: Group, r: Array, free: Array, rate: float, scale: Array | None = None
) -> Array:
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
