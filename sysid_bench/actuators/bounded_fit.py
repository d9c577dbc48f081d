"""Bounded least squares of actuators: armature and friction are not negative, joint by joint.

Deviations come from the residuals of blocks of the recording, whose correlation and unequal size
they hold (Carlstein, Annals of Statistics 14(3), 1986).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.actuators.drive_rows import DriveRows
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
    holds the rows of its m joints below one another."""

    joints: tuple[int, ...]
    A: Array

    @property
    def samples(self) -> int:
        """Samples n of each joint."""
        return len(self.A) // len(self.joints)

    @cached_property
    def factors(self) -> tuple[Array, Array]:
        """Q (m n, 3 + m) and R (3 + m, 3 + m) of A = Q R, which serve all delays."""
        Q, R = np.linalg.qr(self.A)
        return Q, R


@dataclass(frozen=True, eq=False)
class Fit:
    """Values (k, 4) in the order of UNKNOWNS, their deviations, which of them lie on the bound of
    zero, and residuals (N, k)."""

    values: Array
    std: Array
    at_bound: Array
    residuals: Array

    @property
    def errors(self) -> Array:
        """RMS residuals (k,)."""
        return np.asarray(np.sqrt(np.mean(self.residuals**2, axis=0)))


def groups_of(rows: DriveRows, shared: Sequence[str]) -> tuple[Group, ...]:
    """Return the groups of joints: those whose names hold the same word of `shared`, and each
    other joint by itself."""
    labels = [next((w for w in shared if w in name), name) for name in rows.joints]
    members = [
        tuple(i for i, label in enumerate(labels) if label == one) for one in dict.fromkeys(labels)
    ]
    return tuple(Group(joints, _stacked(rows, joints)) for joints in members)


def _stacked(rows: DriveRows, joints: tuple[int, ...]) -> Array:
    """Return the rows of some joints below one another, each with its own constant."""
    own = np.eye(len(joints))
    parts = [
        np.hstack([rows.features[:, j, :SIGNED], np.tile(own[i], (len(rows.features), 1))])
        for i, j in enumerate(joints)
    ]
    return np.concatenate(parts)


def bounded_fit(groups: Sequence[Group], tau: Array, rate: float) -> Fit:
    """Return the fit of torques tau (N, k) at a rate (Hz)."""
    values, std = np.zeros((tau.shape[1], SIGNED + 1)), np.zeros((tau.shape[1], SIGNED + 1))
    residuals = np.empty_like(tau)
    for group in groups:
        b = tau[:, group.joints].T.ravel()
        Q, R = group.factors
        x, free = bounded_solution(R, Q.T @ b)  # |R x - Q'b| and |A x - b| have one minimum
        r = b - group.A @ x
        spread = _deviations(group, r, free, rate)
        for i, j in enumerate(group.joints):
            own = [*range(SIGNED), SIGNED + i]
            values[j], std[j] = x[own], spread[own]
            residuals[:, j] = r[i * group.samples : (i + 1) * group.samples]
    at_bound = values == 0.0
    at_bound[:, SIGNED:] = False
    return Fit(values, std, at_bound, residuals)


def bounded_solution(A: Array, b: Array) -> tuple[Array, Array]:
    """Return x (c,) of the least |A x - b| with its first three not negative, and the indices of
    those that are not on the bound.

    With three bounds all eight active sets are tried, so that the answer is exact.
    """
    count = A.shape[1]
    best, least, best_free = np.zeros(count), np.inf, np.arange(0)
    for free in _active_sets(count):
        x = np.linalg.lstsq(A[:, free], b, rcond=None)[0]
        signed = x[free < SIGNED]
        # A set with negative values is not allowed.
        error = float(np.linalg.norm(A[:, free] @ x - b)) if (signed >= 0.0).all() else np.inf
        if error < least:
            least, best_free = error, free
            best = np.zeros(count)
            best[free] = x
    return best, best_free


def _active_sets(count: int) -> Iterator[Array]:
    """Yield the indices of unknowns that are off their bound, the most first."""
    others = np.arange(SIGNED, count)
    for size in range(SIGNED, -1, -1):
        for signed in combinations(range(SIGNED), size):
            yield np.concatenate([np.array(signed, dtype=int), others])


def _deviations(group: Group, r: Array, free: Array, rate: float) -> Array:
    """Return the deviations (c,) of the free unknowns, zero for those on a bound."""
    A, n = group.A[:, free], group.samples
    length = max(1, min(round(BLOCK * rate), n // BLOCKS))
    starts = np.arange(0, n, length)
    # Joints move together, so that a block holds the residuals of all of them.
    scores = (A * r[:, None]).reshape(len(group.joints), n, -1).sum(axis=0)
    sums = np.add.reduceat(scores, starts, axis=0)
    inverse = np.linalg.pinv(A.T @ A, hermitian=True)
    few = len(starts) / max(1, len(starts) - len(free))
    covariance = few * inverse @ (sums.T @ sums) @ inverse
    std = np.zeros(group.A.shape[1])
    std[free] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return std
