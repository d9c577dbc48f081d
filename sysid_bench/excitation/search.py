"""Search for a motion: sequential quadratic programming (SLSQP, Kraft 1988) over coefficients.

Criterion and smooth maxima of the limits have analytic gradients. Draws are deterministic. An
interrupt, or the end of the budget, leaves the best feasible motion so far.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from scipy.optimize import Bounds, minimize

from sysid_bench.errors import ModelError
from sysid_bench.excitation.criterion import Criterion
from sysid_bench.excitation.design_space import DesignSpace
from sysid_bench.excitation.information import InformationModel
from sysid_bench.excitation.limit_use import Limit, smooth_bound
from sysid_bench.models.coupling.derivatives import Slopes
from sysid_bench.types import Array, Trajectory

Progress = Callable[[int, float], None]
"""(evaluation, best value so far): called after each evaluation once a feasible motion exists."""

_SHARPNESS: Final = (60.0, 240.0)
"""Exponents of the smooth maxima by stage: loose bounds with wide basins, then tight ones."""

_NEAR: Final = 0.6
"""Use of a torque, clearance or box below which its slope is taken as zero: it costs as much as
that of the criterion."""

_NEGLIGIBLE: Final = 1e-7
"""Weight in a smooth maximum below which a sample is skipped."""

_RESTORING: Final = 15
"""Newton steps back into the limits; two or three suffice from nearby."""

_BURST: Final = 12
"""Iterations of a search within a box."""

_GAIN: Final = 0.005
"""Gain of the criterion below which a box is too wide."""

_SMALLEST: Final = 0.01
"""Smallest half width of a box, in scaled coefficients."""

_STEP: Final = 0.2
"""Longest first step, in scaled coefficients: amplitude over the velocity limit (s)."""


class SearchStop(Exception):
    """The budget of evaluations is used up."""


@dataclass
class Search:
    """One search, which counts evaluations and keeps the feasible coefficients that improved."""

    space: DesignSpace
    information: InformationModel
    criterion: Criterion
    limits: tuple[Limit, ...]
    progress: Progress = lambda count, value: None
    budget: int = 10**9  # evaluations of the criterion
    evaluations: int = 0
    kept: list[tuple[float, Array]] = field(default_factory=list)  # the best last
    interrupted: bool = False
    nearest: tuple[float, str] = (np.inf, "")  # least violation met, and its kind of limit

    def __post_init__(self) -> None:
        """Evaluate the bases on the grid of the search."""
        self.t = self.space.curves.grid()
        self.bases = self.space.curves.at(self.t)
        self.shape = (self.space.curves.size, len(self.space.dofs))
        self._C: Array | None = None
        self._near: Trajectory | None = None

    def run(self, starts: list[Array], iterations: int) -> None:
        """Run a short search from every start, and a long one from the best of their ends."""
        best = self.start(starts, iterations)
        if not self.interrupted:
            self.run_from(best, iterations)

    def start(self, starts: list[Array], iterations: int) -> Array:
        """Return the best end (m, k) of short searches with a fifth of the iterations each."""
        ends = [(np.inf, starts[0])]
        with self._graceful_stop():
            for C in starts:
                ends.append(self._descend(C, _SHARPNESS[0], max(iterations // 5, 1)))
        return min(ends[1:] or ends, key=lambda end: end[0])[1]

    def run_from(self, C: Array, iterations: int) -> None:
        """Run a long search from C (m, k), with ever sharper maxima."""
        with self._graceful_stop():
            for sharpness in _SHARPNESS:
                C = self._descend(C, sharpness, iterations)[1]

    @contextmanager
    def _graceful_stop(self) -> Iterator[None]:
        """Keep the best so far where the budget or the user ends the search."""
        try:
            yield
        except SearchStop:
            pass
        except KeyboardInterrupt:
            self.interrupted = True

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

    def box_search(self, C: Array, iterations: int) -> None:
        """Run short searches, each within a box around the best coefficients so far.

        The box widens after a gain and shrinks otherwise. Where many limits bind at once, slopes
        predict little far away.
        """
        radius, left = _STEP / 4, iterations
        with self._graceful_stop():
            self._visit(C)
            while left > 0 and radius > _SMALLEST:
                before = self.kept[-1][0] if self.kept else np.inf
                end = self._descend(C, _SHARPNESS[0], min(_BURST, left), radius)[1]
                for share in (1.0, 0.8, 0.6, 0.4, 0.2):  # backtrack into the limits
                    self._visit(C + share * (end - C))
                    if self.kept and self.kept[-1][0] < before:
                        break
                left -= _BURST
                C = self.kept[-1][1] if self.kept else end
                gained = bool(self.kept) and self.kept[-1][0] < before - _GAIN
                radius *= 1.5 if gained else 0.5

    def _descend(
        self, C: Array, sharpness: float, iterations: int, radius: float = np.inf
    ) -> tuple[float, Array]:
        """Return criterion and coefficients at the end of a search from C, at most `radius` of
        scaled coefficients away."""
        # A unit of each scaled coefficient moves its joint by the same share of the limits.
        scale = np.tile(self._scale(), (self.shape[0], 1))
        low, high = self.space.bounds()
        C = np.clip(C, low, high)
        box = np.maximum(low, C - radius * scale), np.minimum(high, C + radius * scale)
        end = self._restored(self._minimised(C, scale, box, sharpness, iterations), sharpness)
        over = max(self.largest_use(end) - 1.0, 0.0)
        return self.objective(end) + 100 * over, end

    def _minimised(
        self,
        C: Array,
        scale: Array,
        box: tuple[Array, Array],
        sharpness: float,
        iterations: int,
    ) -> Array:
        """Return the coefficients (m, k) at the end of SLSQP, started at C."""
        start = (C / scale).ravel()
        low, high = (edge / scale for edge in box)

        def unscaled(x: Array) -> Array:
            return np.asarray(x.reshape(self.shape) * scale)

        constraint: Any = {
            "type": "ineq",
            "fun": lambda x: 1.0 - self._limits_at(unscaled(x), sharpness)[0],
            "jac": lambda x: -self._limits_at(unscaled(x), sharpness)[1] * scale.ravel(),
        }
        steepest = float(np.abs(self._slope_at(unscaled(start)) * scale).max())
        # SLSQP starts with a unit Hessian: the first step is the gradient itself.
        unit = _STEP / max(steepest, _STEP)
        result = minimize(
            lambda x: unit * self._value_at(unscaled(x)),
            start,
            jac=lambda x: unit * self._slope_at(unscaled(x)).ravel() * scale.ravel(),
            method="SLSQP",
            constraints=[constraint],
            bounds=Bounds(low.ravel(), high.ravel()),
            options={"maxiter": iterations, "ftol": 1e-5 * unit},  # type: ignore[call-overload]
        )
        return unscaled(result.x)

    def _restored(self, C: Array, sharpness: float) -> Array:
        """Return the nearest coefficients within the limits, by Newton steps of least norm; the
        least violating ones where none keeps all limits.

        A search cut off by its iterations ends a few per cent outside.
        """
        scale = np.tile(self._scale(), (self.shape[0], 1))
        low, high = self.space.bounds()
        nearest, least = C, np.inf
        for _ in range(_RESTORING):
            value, slope = self._limits_at(C, sharpness)
            if value.max() < least:
                nearest, least = C, float(value.max())
            if least <= 1.0:
                break
            # Nearly active limits take part, or a step would only trade one limit for another.
            binding = value > 0.97
            J = slope[binding] * scale.ravel()
            step = np.linalg.lstsq(J, np.minimum(0.995 - value[binding], 0.0), rcond=1e-3)[0]
            step *= min(1.0, _STEP / np.abs(step).max())
            C = np.clip(C + step.reshape(self.shape) * scale, low, high)
        return nearest

    def _scale(self) -> Array:
        return np.asarray(self.space.brief.v[self.space.dofs])

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

    def _visit(self, C: Array) -> None:
        """Evaluate criterion and limits at C once for the calls of value, slope and constraints.

        Raises SearchStop at the end of the budget.
        """
        if self._C is not None and np.array_equal(self._C, C):
            return
        if self.evaluations >= self.budget:
            raise SearchStop
        self.evaluations += 1
        motion = self._motion_or_none(C)
        if motion is None and self._C is not None:
            # The closure is lost or singular there: too long a step. The slopes stay as they were,
            # and the infinite value makes the line search come back.
            self._C, self._value = C.copy(), np.inf
            return
        self._C = C.copy()
        self._current = self._near = self._motion(C) if motion is None else motion
        self._W = self._rows(self._current)
        self._value = self.criterion.value(self._W)
        self._thin = [_thinned(self._current, limit.every) for limit in self.limits]
        self._uses = [limit.use(thin) for limit, thin in zip(self.limits, self._thin, strict=True)]
        self._keep_feasible(C)

    def _keep_feasible(self, C: Array) -> None:
        """Keep the coefficients just evaluated if they are within the limits and the best."""
        largest = [float(np.abs(use).max()) for use in self._uses]
        worst = self.limits[int(np.argmax(largest))]
        self.nearest = min(self.nearest, (max(largest), worst.kind))
        better = not self.kept or self._value < self.kept[-1][0]
        if max(largest) <= 1.0 and np.isfinite(self._value) and better:
            self.kept.append((self._value, C.copy()))
        if self.kept:
            self.progress(self.evaluations, self.kept[-1][0])

    def _value_at(self, C: Array) -> float:
        self._visit(C)
        # SLSQP needs finite values.
        return self._value if np.isfinite(self._value) else 1e3

    def _slope_at(self, C: Array) -> Array:
        self._visit(C)
        by_W = self.criterion.gradient(self._W)
        G = by_W.reshape(len(self.t), -1, by_W.shape[1])
        return self._coefficients(self._current, self.information.gradient(self._current, G))

    def _coefficients(self, motion: Trajectory, slopes: Slopes, every: int = 1) -> Array:
        """Return slopes by C (m, k) from those by q, v, a (N, nv) of one sample of `every`."""
        pairs = zip(self.bases, self.space.profile_gradient(motion, slopes), strict=True)
        return np.asarray(sum(B[::every].T @ slope for B, slope in pairs))

    def _limits_at(self, C: Array, sharpness: float) -> tuple[Array, Array]:
        """Return smooth maxima (n,) of the limits at C, and their slopes (n, m k)."""
        self._visit(C)
        values, slopes = [], []
        for limit, use, thin in zip(self.limits, self._uses, self._thin, strict=True):
            for value, slope in self._constraints(limit, use, thin, sharpness):
                values.append(value)
                slopes.append(slope.ravel())
        return np.array(values), np.array(slopes)

    def _constraints(
        self, limit: Limit, use: Array, motion: Trajectory, sharpness: float
    ) -> Iterator[tuple[float, Array]]:
        """Yield smooth maximum and slope (m, k) of each constraint of a limit with uses (N, c)."""
        columns = use.reshape(-1, 1) if limit.split == "together" else use
        value, weight = smooth_bound(columns, sharpness)
        if limit.split == "by joint":
            # The columns share no coefficient: one product yields the slopes of all.
            combined = self._coefficients(motion, limit.slopes(motion, weight), limit.every)
            for j in range(len(value)):
                slope = np.zeros(self.shape)
                slope[:, j] = combined[:, j]
                yield float(value[j]), slope
            return
        if limit.split == "by moment":
            slopes_at = self._moment_slopes(limit, motion, weight * (value >= _NEAR))
            yield from zip(value.tolist(), slopes_at, strict=True)
            return
        for j in range(len(value)):
            if value[j] < _NEAR:
                yield float(value[j]), np.zeros(self.shape)
                continue
            G = weight if limit.split == "together" else weight * (np.arange(len(value)) == j)
            slopes = limit.slopes(motion, G.reshape(use.shape))
            yield float(value[j]), self._coefficients(motion, slopes, limit.every)

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
