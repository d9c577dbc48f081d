"""Evaluation of coefficients in a search: criterion and smooth maxima of the limits, with analytic
gradients.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sysid_bench.errors import ModelError
from sysid_bench.excitation.criterion import Criterion
from sysid_bench.excitation.design_space import DesignSpace
from sysid_bench.excitation.information import InformationModel
from sysid_bench.excitation.limit_use import Limit, smooth_bound
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.types import Array, Trajectory

Progress = Callable[[int, float], None]
"""(evaluation, best value so far): called after each evaluation once a feasible motion exists."""

Constraint = tuple[float, Array]
"""Smooth maximum of uses, and its slope by the coefficients (m, k)."""

_NEAR: Final = 0.6
"""Use of a torque, clearance or box below which its slope is taken as zero: it costs as much as
that of the criterion."""

_NEGLIGIBLE: Final = 1e-7
"""Weight in a smooth maximum below which a sample is skipped."""


class SearchEnd(Exception):
    """The budget of evaluations is used up."""


@dataclass
class DesignEvaluation:
    """Criterion and limits of a search, which counts evaluations and keeps the feasible
    coefficients that improved."""

    space: DesignSpace
    information: InformationModel
    criterion: Criterion
    limits: tuple[Limit, ...]
    progress: Progress = lambda count, value: None
    budget: int = 10**9  # evaluations of the criterion
    evaluations: int = 0
    kept: list[tuple[float, Array]] = field(default_factory=list)  # the best last
    nearest: tuple[float, str] = (np.inf, "")  # least violation met, and its kind of limit
    density: int = 1  # of the grid, times that of a search

    def __post_init__(self) -> None:
        """Evaluate the bases on the grid of the search."""
        self.t = self.space.curves.grid(self.density)
        self.bases = self.space.curves.at(self.t)
        self.shape = (self.space.curves.size, len(self.space.dofs))
        self._C: Array | None = None
        self._near: Trajectory | None = None

    @property
    def best(self) -> float:
        """Least value of a feasible motion so far; infinity without one."""
        return self.kept[-1][0] if self.kept else np.inf

    def objective(self, C: Array) -> float:
        """Return the criterion alone, infinity where a closed chain cannot be closed."""
        motion = self._motion_or_none(C)
        return np.inf if motion is None else self.criterion.value(self._rows(motion))

    def largest_use(self, C: Array) -> float:
        """Return the largest use of any limit on the grid of the search."""
        motion = self._motion_or_none(C)
        if motion is None:
            return np.inf
        return max(
            float(np.abs(limit.use(_thinned(motion, limit.every))).max()) for limit in self.limits
        )

    def value(self, C: Array) -> float:
        """Return the criterion at C (m, k), a large number where it is infinite: SLSQP needs
        finite values."""
        self.evaluate(C)
        return self._value if np.isfinite(self._value) else 1e3

    def gradient(self, C: Array) -> Array:
        """Return the slope (m, k) of the criterion at C."""
        self.evaluate(C)
        by_W = self.criterion.gradient(self._W)
        G = by_W.reshape(len(self.t), -1, by_W.shape[1])
        return self._coefficients(self._current, self.information.gradient(self._current, G))

    def smooth_limits(self, C: Array, sharpness: float) -> tuple[Array, Array]:
        """Return smooth maxima (n,) of the limits at C, and their slopes (n, m k)."""
        self.evaluate(C)
        values, slopes = [], []
        for limit, use, thin in zip(self.limits, self.uses, self._thin, strict=True):
            for value, slope in self._constraints(limit, use, thin, sharpness):
                values.append(value)
                slopes.append(slope.ravel())
        return np.array(values), np.array(slopes)

    def evaluate(self, C: Array) -> None:
        """Evaluate criterion and limits at C once for the calls of value, slope and constraints.

        Raises SearchEnd at the end of the budget.
        """
        if self._C is not None and np.array_equal(self._C, C):
            return
        if self.evaluations >= self.budget:
            raise SearchEnd
        self.evaluations += 1
        motion = self._motion_or_none(C)
        if motion is None and self._C is not None:
            # The closure is lost or singular there: too long a step. The slopes stay as they were,
            # and the infinite value makes the line search come back.
            self._C, self._value = C.copy(), np.inf
            return
        self._C = C.copy()
        self._store(self._motion(C) if motion is None else motion)
        self._keep_feasible(C)

    def _store(self, motion: Trajectory) -> None:
        """Keep criterion and uses of a motion, which value, slopes and limits share."""
        # The next motion of a search is near this one, which saves steps of the closure.
        self._current = self._near = motion
        self._W = self._rows(motion)
        self._value = self.criterion.value(self._W)
        self._thin = [_thinned(motion, limit.every) for limit in self.limits]
        self.uses = [limit.use(thin) for limit, thin in zip(self.limits, self._thin, strict=True)]

    def _keep_feasible(self, C: Array) -> None:
        """Keep the coefficients just evaluated if they are within the limits and the best."""
        largest = [float(np.abs(use).max()) for use in self.uses]
        worst = self.limits[int(np.argmax(largest))]
        self.nearest = min(self.nearest, (max(largest), worst.kind))
        if max(largest) <= 1.0 and np.isfinite(self._value) and self._value < self.best:
            self.kept.append((self._value, C.copy()))
        if self.kept:
            self.progress(self.evaluations, self.best)

    def _motion(self, C: Array) -> Trajectory:
        return self.space.sampled_motion(C, self.t, self.bases, self._near)

    def _motion_or_none(self, C: Array) -> Trajectory | None:
        try:
            return self._motion(C)
        except ModelError:
            return None

    def _rows(self, motion: Trajectory) -> Array:
        Y = self.information.rows(motion)
        return Y.reshape(-1, Y.shape[2])

    def _coefficients(self, motion: Trajectory, slopes: Slopes, every: int = 1) -> Array:
        """Return slopes by C (m, k) from those by q, v, a (N, nv) of one sample of `every`."""
        pairs = zip(self.bases, self.space.profile_gradient(motion, slopes), strict=True)
        return np.asarray(sum(B[::every].T @ slope for B, slope in pairs))

    def _constraints(
        self, limit: Limit, use: Array, motion: Trajectory, sharpness: float
    ) -> Iterator[Constraint]:
        """Yield the constraints of a limit with uses (N, c)."""
        columns = use.reshape(-1, 1) if limit.split == "together" else use
        value, weight = smooth_bound(columns, sharpness)
        if limit.split == "by joint":
            yield from self._joint_constraints(limit, motion, value, weight)
        elif limit.split == "by moment":
            slopes = self._moment_slopes(limit, motion, weight * (value >= _NEAR))
            yield from zip(value.tolist(), slopes, strict=True)
        else:
            yield from self._column_constraints(limit, motion, value, weight, use.shape)

    def _joint_constraints(
        self, limit: Limit, motion: Trajectory, value: Array, weight: Array
    ) -> Iterator[Constraint]:
        """Yield constraints whose columns share no coefficient: one product yields all slopes."""
        combined = self._coefficients(motion, limit.slopes(motion, weight), limit.every)
        for j in range(len(value)):
            slope = np.zeros(self.shape)
            slope[:, j] = combined[:, j]
            yield float(value[j]), slope

    def _column_constraints(
        self, limit: Limit, motion: Trajectory, value: Array, weight: Array, shape: tuple[int, ...]
    ) -> Iterator[Constraint]:
        """Yield one constraint per column of weights, or a single one for all uses of `shape`."""
        for j in range(len(value)):
            slope = np.zeros(self.shape)
            if value[j] >= _NEAR:  # a query of MuJoCo per sample: worth it near the limit only
                G = weight if limit.split == "together" else weight * (np.arange(len(value)) == j)
                slopes = limit.slopes(motion, G.reshape(shape))
                slope = self._coefficients(motion, slopes, limit.every)
            yield float(value[j]), slope

    def _moment_slopes(self, limit: Limit, motion: Trajectory, weight: Array) -> Array:
        """Return slopes (c, m, k) of every column from the few samples that weigh in it.

        `weight` (N, c); the samples of all columns are evaluated as one motion.
        """
        slopes = np.zeros((weight.shape[1], *self.shape))
        samples, columns = np.nonzero(np.abs(weight) > _NEGLIGIBLE)
        if len(samples) == 0:
            return slopes
        part = _selected(motion, samples)
        G = np.zeros((len(samples), weight.shape[1]))
        G[np.arange(len(samples)), columns] = weight[samples, columns]
        by_profiles = self.space.profile_gradient(part, limit.slopes(part, G))
        for column in np.unique(columns):
            chosen = columns == column
            for B, slope in zip(self.bases, by_profiles, strict=True):
                slopes[column] += B[:: limit.every][samples[chosen]].T @ slope[chosen]
        return slopes


def _selected(motion: Trajectory, samples: Array | slice) -> Trajectory:
    t, q, v, a = (array[samples] for array in (motion.t, motion.q, motion.v, motion.a))
    return Trajectory(t, q, v, a)


def _thinned(motion: Trajectory, every: int) -> Trajectory:
    return motion if every == 1 else _selected(motion, slice(None, None, every))
