"""Evaluation of coefficients in a search: criterion and smooth maxima of the limits, with analytic
gradients.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
import scipy

from sysid_bench.errors import ModelError
from sysid_bench.excitation.design_space import DesignSpace
from sysid_bench.excitation.information import Criterion, InformationModel
from sysid_bench.excitation.limits import Limit, smooth_bound
from sysid_bench.models.coupling.pullback import Slopes
from sysid_bench.types import Array, Trajectory

Progress = Callable[[int, float], None]
"""(evaluation, best value so far): called after each evaluation once a feasible motion exists."""

Constraint = tuple[float, Array]
"""Smooth maximum of uses, and its slope by the coefficients (m, k)."""

_NEAR: Final = 0.6
"""Use of a torque, clearance or box below which its slope is taken as zero: it costs as much as
that of the criterion."""

_WINDOWS: Final = 8
"""Windows of a motion, each with smooth maxima of its own: a motion touches a limit at several
moments, and one maximum of them all has the slope of the highest alone."""

_CONSTRAINTS: Final = 240
"""Constraints above which there are fewer windows: SLSQP's time grows with their number."""

_NEGLIGIBLE: Final = 1e-7
"""Weight in a smooth maximum below which a sample is skipped."""


class SearchEnd(Exception):
    """The budget of evaluations is used up."""


@dataclass
class DesignCost:
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

    def criterion_value(self, C: Array) -> float:
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
        """Return smooth maxima (n,) of the limits at C in each window of the motion, and their
        slopes (n, m k)."""
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
        motion = self._motion(C) if motion is None else motion
        # The next motion of a search is near this one, which saves steps of the closure.
        self._current = self._near = motion
        self._W = self._rows(motion)
        self._value = self.criterion.value(self._W)
        self._thin = [_thinned(motion, limit.every) for limit in self.limits]
        self.uses = [limit.use(thin) for limit, thin in zip(self.limits, self._thin, strict=True)]
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

    @cached_property
    def _windows(self) -> int:
        columns = sum(1 if one.split == "together" else len(one.names) for one in self.limits)
        return int(np.clip(_CONSTRAINTS // max(columns, 1), 1, _WINDOWS))

    def names(self) -> Iterator[str]:
        """Yield "kind name" of each constraint, in the order of `smooth_limits`."""
        for limit in self.limits:
            if limit.split == "together":
                yield limit.kind
            else:
                yield from [f"{limit.kind} {name}" for name in limit.names] * self._windows

    def _constraints(
        self, limit: Limit, use: Array, motion: Trajectory, sharpness: float
    ) -> Iterator[Constraint]:
        """Yield the constraints of a limit with uses (N, c): of each column in the first window,
        then in the second, ..."""
        if limit.split == "together":
            whole, weight = smooth_bound(use.reshape(-1, 1), sharpness)
            slope = np.zeros(self.shape)
            if whole[0] >= _NEAR:
                slopes_by_motion = limit.slopes(motion, weight.reshape(use.shape))
                slope = self._coefficients(motion, slopes_by_motion, limit.every)
            yield float(whole[0]), slope
            return
        bounds = [smooth_bound(use[part], sharpness) for part in self._parts(len(use))]
        value = np.array([bound[0] for bound in bounds])
        weight = np.concatenate([bound[1] for bound in bounds])
        if limit.split == "by joint":
            # Columns share no coefficient: one product yields their slopes (windows, c, m, k).
            combined = self._by_window(motion, limit.slopes(motion, weight), limit.every)
            joints = np.arange(combined.shape[2])
            slopes = np.zeros((len(combined), len(joints), *self.shape))
            slopes[:, joints, :, joints] = combined.transpose(2, 0, 1)
        else:
            near = np.repeat(value >= _NEAR, [len(bound[1]) for bound in bounds], axis=0)
            find = self._moment_slopes if limit.split == "by moment" else self._column_slopes
            slopes = find(limit, motion, weight * near)
        yield from zip(value.ravel().tolist(), slopes.reshape(-1, *self.shape), strict=True)

    def _parts(self, count: int) -> list[slice]:
        """Return the windows of `count` samples."""
        edges = np.linspace(0, count, self._windows + 1).astype(int)
        return [slice(*pair) for pair in pairwise(edges.tolist())]

    def _by_window(self, motion: Trajectory, slopes: Slopes, every: int) -> Array:
        """Return slopes by C (windows, m, k) from those by q, v, a (N, nv) of one sample of
        `every`, added up within each window."""
        pairs = list(zip(self.bases, self.space.profile_gradient(motion, slopes), strict=True))
        parts = self._parts(len(motion))
        return np.array([sum(B[::every][p].T @ slope[p] for B, slope in pairs) for p in parts])

    def _column_slopes(self, limit: Limit, motion: Trajectory, weight: Array) -> Array:
        """Return slopes (windows, c, m, k), of weights (N, c), from one column after the other."""
        slopes = np.zeros((self._windows, weight.shape[1], *self.shape))
        for j in np.flatnonzero(weight.any(axis=0)):  # a query of MuJoCo per sample
            G = weight * (np.arange(weight.shape[1]) == j)
            slopes[:, j] = self._by_window(motion, limit.slopes(motion, G), limit.every)
        return slopes

    def _moment_slopes(self, limit: Limit, motion: Trajectory, weight: Array) -> Array:
        """Return slopes (windows, c, m, k) from the few samples that weigh in each column.

        `weight` (N, c); the samples of all columns are evaluated as one motion.
        """
        slopes = np.zeros((self._windows, weight.shape[1], *self.shape))
        samples, columns = np.nonzero(np.abs(weight) > _NEGLIGIBLE)
        if len(samples) == 0:
            return slopes
        part = _selected(motion, samples)
        G = np.zeros((len(samples), weight.shape[1]))
        G[np.arange(len(samples)), columns] = weight[samples, columns]
        by_profiles = self.space.profile_gradient(part, limit.slopes(part, G))
        for k, window in enumerate(self._parts(len(motion))):
            inside = (samples >= window.start) & (samples < window.stop)
            for column in np.unique(columns[inside]):
                chosen = inside & (columns == column)
                for B, slope in zip(self.bases, by_profiles, strict=True):
                    slopes[k, column] += B[:: limit.every][samples[chosen]].T @ slope[chosen]
        return slopes


def _selected(motion: Trajectory, samples: Array | slice) -> Trajectory:
    t, q, v, a = (array[samples] for array in (motion.t, motion.q, motion.v, motion.a))
    return Trajectory(t, q, v, a)


def _thinned(motion: Trajectory, every: int) -> Trajectory:
    return motion if every == 1 else _selected(motion, slice(None, None, every))


_ACTIVE: Final = 0.95
"""Use above which a limit may be active: a search stops a little inside."""

_SHARPNESS: Final = 1000.0
"""Exponent of the smooth maxima, .3 % above the true ones."""

_LEAST: Final = 1e-3
"""Price below which a limit costs nothing."""


@dataclass(frozen=True)
class LimitSensitivity:
    """Prices by "kind name", the largest first, and the `balance`: the share of the squared slope
    of the criterion that the active limits oppose. It is one at an optimum; less before it, and
    where two singular values are the smallest together, so that the criterion has no one slope."""

    prices: Mapping[str, float]
    balance: float


NONE: Final = LimitSensitivity({}, 0.0)
"""No active limit."""


def limit_sensitivity(evaluation: DesignCost, C: Array) -> LimitSensitivity:
    """Return the decrease of the criterion per relative widening of each active limit at the
    coefficients C (m, k) of an optimum.

    Of ln cond it is -d ln cond / d ln limit: .5 for a limit that is 10 % wider and a condition that
    is 5 % smaller.
    """
    values, slopes = evaluation.smooth_limits(C, _SHARPNESS)
    active = values > _ACTIVE
    if not active.any():
        return NONE
    # Coefficients of fast joints would otherwise outweigh those of slow ones.
    v = evaluation.space.brief.v[evaluation.space.dofs]
    scale = np.tile(v, evaluation.shape[0])
    slope = -evaluation.gradient(C).ravel() * scale
    try:
        multipliers, left = scipy.optimize.nnls((slopes[active] * scale).T, slope)
    except RuntimeError:  # more iterations than it takes
        return NONE
    names = [name for name, keeps in zip(evaluation.names(), active, strict=True) if keeps]
    found: dict[str, float] = {}
    for name, price in zip(names, (multipliers * values[active]).tolist(), strict=True):
        found[name] = found.get(name, 0.0) + price  # of all moments
    found = {name: price for name, price in found.items() if price > _LEAST}
    balance = 1.0 - (left / max(float(np.linalg.norm(slope)), 1e-300)) ** 2
    return LimitSensitivity(dict(sorted(found.items(), key=lambda item: -item[1])), float(balance))
