"""The search for a motion: sequential quadratic programming (SLSQP) over coefficients of curves,
with analytic slopes of the criterion and smooth maxima of the limits.

Deterministic in its draws. An interrupt, or the end of the budget, leaves the best feasible so far.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from scipy.optimize import Bounds, minimize

from sysid_bench.errors import ModelError
from sysid_bench.excitation.criteria import Criterion
from sysid_bench.excitation.curves import Curves
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.information import InformationModel
from sysid_bench.excitation.limit_use import Limit, smooth_max
from sysid_bench.models.coupling.derivatives import Slopes, pull_back
from sysid_bench.types import Array, Trajectory

Tell = Callable[[int, float], None]
"""(evaluation, best value so far): a progress line."""

SHARPNESS: Final = (60.0, 240.0)
"""Of the smooth maxima, stage by stage: first far-sighted, then close to the true limits."""

NEAR: Final = 0.6
"""A torque, clearance or box that uses less of its limit is not looked at closer: its slope costs
as much as that of the criterion."""

FAINT: Final = 1e-7
"""Of the weights of a smooth maximum: samples below it change nothing."""

RESTORING: Final = 15
"""Newton steps back into the limits; two or three do where the way is short."""

BURST: Final = 12
"""Iterations of a search within a box."""

GAIN: Final = 0.005
"""Of the criterion: a search that gains less is at its end."""

SMALLEST: Final = 0.01
"""Of a box, in units of scaled coefficients."""

STEP: Final = 0.2
"""The longest such step, in units of scaled coefficients: an amplitude over the velocity limit."""


@dataclass(frozen=True, eq=False)
class DesignSpace:
    """Motions of some degrees of freedom along curves: coefficients C (m, k) of the k `dofs`; the
    others are held at the reference configuration, or follow. `dofs` are places among the profiles
    of the brief."""

    brief: DesignProblem
    curves: Curves
    dofs: Array

    def motion(self, C: Array, t: Array) -> Trajectory:
        """The motion of coefficients C at times t (N,)."""
        return self.sampled_motion(C, t, self.curves.at(t))

    def sampled_motion(
        self,
        C: Array,
        t: Array,
        bases: tuple[Array, Array, Array],
        near: Trajectory | None = None,
    ) -> Trajectory:
        """The same with the bases at hand, and maybe a motion near it."""
        x, dx, ddx = (B @ C for B in bases)
        q = np.tile(self.brief.q0, (len(t), 1))
        v, a = np.zeros((2, len(t), sum(len(joint.dofs) for joint in self.brief.joints)))
        moving = self.moving_joints
        q[:, self.places], v[:, moving], a[:, moving] = x, dx, ddx
        period = self.curves.duration if self.curves.periodic else None
        return self.brief.completed(Trajectory(t, q, v, a, self.curves.kind, period), near)

    @property
    def moving_joints(self) -> Array:
        """Places of the moving degrees of freedom in v."""
        return self.brief.dofs[self.dofs]

    @property
    def places(self) -> list[int]:
        """Places of the moving degrees of freedom in q."""
        where = {joint.vadr: joint.qadr for joint in self.brief.joints}
        return [where[int(dof)] for dof in self.moving_joints]

    def _by_profiles(self, motion: Trajectory, slopes: Slopes) -> Slopes:
        """Slopes by x, dx, ddx (N, k) of what is chosen, from those by q, v, a of every joint."""
        if self.brief.coupling is not None:
            slopes = pull_back(self.brief.coupling, motion, slopes)
        x, dx, ddx = (slope[:, self.moving_joints] for slope in slopes)
        return x, dx, ddx

    def bounds(self) -> tuple[Array, Array]:
        """Coefficients (m, k) that no motion within the limits goes beyond: a harmonic of a curve
        is at most 4 / pi of the curve's largest value. Steps of a search are kept inside; a
        function of other families may be compensated by its neighbours, and gets more room."""
        brief, dofs = self.brief, self.dofs
        room = 4 / np.pi if self.curves.kind == "fourier" else 4.0
        x, dx, ddx = (np.abs(B).max(axis=0)[1:, None] for B in self.curves.at(self.curves.grid()))
        half = 0.5 * (brief.high - brief.low)[dofs]
        most = np.min([half / x, brief.v[dofs] / dx, brief.a[dofs] / ddx], axis=0)
        high = np.vstack([brief.high[dofs], room * most])
        return np.vstack([brief.low[dofs], -room * most]), high

    def random(self, rng: np.random.Generator, share: float) -> Array:
        """Coefficients of a random motion that uses `share` of the position, velocity or
        acceleration limit of every joint, whichever comes first; its place is drawn."""
        brief, dofs = self.brief, self.dofs
        bases = self.curves.at(self.curves.grid())
        C = rng.normal(size=(self.curves.size, len(dofs)))
        C[0] = 0.0
        x, dx, ddx = (B @ C for B in bases)
        room = (brief.high - brief.low)[dofs]
        C *= share / np.max(
            [
                np.ptp(x, axis=0) / room,
                np.abs(dx).max(axis=0) / brief.v[dofs],
                np.abs(ddx).max(axis=0) / brief.a[dofs],
            ],
            axis=0,
        )
        x = bases[0] @ C
        first = brief.low[dofs] + 0.5 * (1 - share) * room - x.min(axis=0)
        last = brief.high[dofs] - 0.5 * (1 - share) * room - x.max(axis=0)
        C[0] = first + rng.uniform(size=len(dofs)) * np.maximum(last - first, 0.0)
        return C


class SearchStopped(Exception):
    """The budget of evaluations is used up."""


@dataclass
class Search:
    """One search; it keeps count and the best feasible coefficients, so that it can be stopped."""

    space: DesignSpace
    question: InformationModel
    criterion: Criterion
    limits: tuple[Limit, ...]
    tell: Tell = lambda count, value: None
    most: int = 10**9  # evaluations of the criterion
    evaluations: int = 0
    kept: list[tuple[float, Array]] = field(default_factory=list)  # the best last
    interrupted: bool = False
    nearest: tuple[float, str] = (np.inf, "")  # the least violation met, and of what

    def __post_init__(self) -> None:
        """Bases on the grid of the search, once."""
        self.t = self.space.curves.grid()
        self.bases = self.space.curves.at(self.t)
        self.shape = (self.space.curves.size, len(self.space.dofs))
        self._at: Array | None = None
        self._near: Trajectory | None = None

    def run(self, starts: list[Array], iterations: int) -> None:
        """A short search from every start, a long one from the best of their ends."""
        best = self.start(starts, iterations)
        if not self.interrupted:
            self.resume(best, iterations)

    def start(self, starts: list[Array], iterations: int) -> Array:
        """The best end (m, k) of short searches, a fifth of the iterations from every start."""
        ends = [(np.inf, starts[0])]
        with self._stopped_in_order():
            for C in starts:
                ends.append(self._descend(C, SHARPNESS[0], max(iterations // 5, 1)))
        return min(ends[1:] or ends, key=lambda end: end[0])[1]

    def resume(self, C: Array, iterations: int) -> None:
        """A long search from C, stage by stage."""
        with self._stopped_in_order():
            for sharpness in SHARPNESS:
                C = self._descend(C, sharpness, iterations)[1]

    @contextmanager
    def _stopped_in_order(self) -> Iterator[None]:
        """What was kept stays, whoever ends the search."""
        try:
            yield
        except SearchStopped:
            pass
        except KeyboardInterrupt:
            self.interrupted = True

    def objective(self, C: Array) -> float:
        """The criterion alone, for ranking starts."""
        motion = self._motion_or_none(C)
        return np.inf if motion is None else self.criterion.value(self._rows(motion))

    def largest_use(self, C: Array) -> float:
        """The largest use of any limit on the grid of the search."""
        motion = self._motion_or_none(C)
        if motion is None:
            return np.inf
        return max(
            float(np.abs(limit.use(_thinned(motion, limit.every))).max()) for limit in self.limits
        )

    def short_steps(self, C: Array, iterations: int) -> None:
        """A search that stays near what it has kept: short searches, each within a box around the
        best coefficients so far, wider after one that gained and narrower after one that did not.
        Where many limits bind at once, slopes tell too little of what is far."""
        radius, left = STEP / 4, iterations
        with self._stopped_in_order():
            self._visit(C)
            while left > 0 and radius > SMALLEST:
                before = self.kept[-1][0] if self.kept else np.inf
                end = self._descend(C, SHARPNESS[0], min(BURST, left), radius)[1]
                for share in (1.0, 0.8, 0.6, 0.4, 0.2):  # as far towards it as the limits are kept
                    self._visit(C + share * (end - C))
                    if self.kept and self.kept[-1][0] < before:
                        break
                left -= BURST
                C = self.kept[-1][1] if self.kept else end
                gained = bool(self.kept) and self.kept[-1][0] < before - GAIN
                radius *= 1.5 if gained else 0.5

    def _descend(
        self, C: Array, sharpness: float, iterations: int, radius: float = np.inf
    ) -> tuple[float, Array]:
        """The end of a search from C, at most `radius` of scaled coefficients away."""
        # Columns are scaled so that a unit of each coefficient moves a share of the limits.
        scale = np.tile(self._scale(), (self.shape[0], 1))
        low, high = self.space.bounds()
        C = np.clip(C, low, high)
        low, high = np.maximum(low, C - radius * scale), np.minimum(high, C + radius * scale)
        start = (C / scale).ravel()
        constraint: Any = {
            "type": "ineq",
            "fun": lambda x: 1.0 - self._limits_at(x.reshape(self.shape) * scale, sharpness)[0],
            "jac": lambda x: (
                -self._limits_at(x.reshape(self.shape) * scale, sharpness)[1] * scale.ravel()
            ),
        }
        steepest = float(np.abs(self._slope_at(start.reshape(self.shape) * scale) * scale).max())
        unit = STEP / max(steepest, STEP)  # the first step goes as far as the slope says
        result = minimize(
            lambda x: unit * self._value_at(x.reshape(self.shape) * scale),
            start,
            jac=lambda x: (
                unit * self._slope_at(x.reshape(self.shape) * scale).ravel() * scale.ravel()
            ),
            method="SLSQP",
            constraints=[constraint],
            bounds=Bounds((low / scale).ravel(), (high / scale).ravel()),
            options={"maxiter": iterations, "ftol": 1e-5 * unit},  # type: ignore[call-overload]
        )
        end = self._restored(result.x.reshape(self.shape) * scale, sharpness)
        over = max(self.largest_use(end) - 1.0, 0.0)
        return self.objective(end) + 100 * over, end

    def _restored(self, C: Array, sharpness: float) -> Array:
        """The nearest coefficients within the limits, by Newton steps of least length: a search
        that is cut off hovers a few per cent outside. Steps stay short, for slopes tell little of
        what is far; the least violating coefficients are the answer where none keeps all."""
        scale = np.tile(self._scale(), (self.shape[0], 1))
        low, high = self.space.bounds()
        nearest, least = C, np.inf
        for _ in range(RESTORING):
            value, slope = self._limits_at(C, sharpness)
            if value.max() < least:
                nearest, least = C, float(value.max())
            if least <= 1.0:
                break
            # Limits that are near bind as well, or a step would only trade one for another.
            binding = value > 0.97
            J = slope[binding] * scale.ravel()
            step = np.linalg.lstsq(J, np.minimum(0.995 - value[binding], 0.0), rcond=1e-3)[0]
            step *= min(1.0, STEP / np.abs(step).max())
            C = np.clip(C + step.reshape(self.shape) * scale, low, high)
        return nearest

    def _scale(self) -> Array:
        return self.space.brief.v[self.space.dofs]

    def _motion(self, C: Array) -> Trajectory:
        return self.space.sampled_motion(C, self.t, self.bases, self._near)

    def _motion_or_none(self, C: Array) -> Trajectory | None:
        try:
            return self._motion(C)
        except ModelError:
            return None

    def _rows(self, motion: Trajectory) -> Array:
        Y = self.question.rows(motion)
        return Y.reshape(-1, Y.shape[2])

    def _visit(self, C: Array) -> None:
        """Everything about coefficients that the solver looks at, computed once."""
        if self._at is not None and np.array_equal(self._at, C):
            return
        if self.evaluations >= self.most:
            raise SearchStopped
        self.evaluations += 1
        motion = self._motion_or_none(C)
        if motion is None and self._at is not None:
            # The closure is lost there, or singular: a step too far. The rest stays as it was.
            self._at, self._f = C.copy(), np.inf
            return
        self._at = C.copy()
        self._here = self._near = self._motion(C) if motion is None else motion
        self._W = self._rows(self._here)
        self._f = self.criterion.value(self._W)
        self._thin = [_thinned(self._here, limit.every) for limit in self.limits]
        self._uses = [limit.use(thin) for limit, thin in zip(self.limits, self._thin, strict=True)]
        most = [float(np.abs(use).max()) for use in self._uses]
        self.nearest = min(self.nearest, (max(most), self.limits[int(np.argmax(most))].kind))
        if (
            max(most) <= 1.0
            and np.isfinite(self._f)
            and (not self.kept or self._f < self.kept[-1][0])
        ):
            self.kept.append((self._f, C.copy()))
        if self.kept:
            self.tell(self.evaluations, self.kept[-1][0])

    def _value_at(self, C: Array) -> float:
        self._visit(C)
        return self._f if np.isfinite(self._f) else 1e3

    def _slope_at(self, C: Array) -> Array:
        self._visit(C)
        by_W = self.criterion.gradient(self._W)
        G = by_W.reshape(len(self.t), -1, by_W.shape[1])
        return self._coefficients(self._here, self.question.gradient(self._here, G))

    def _coefficients(self, motion: Trajectory, slopes: Slopes, every: int = 1) -> Array:
        """Slopes by C (m, k) from those by q, v, a (N, nv) of one sample of `every`."""
        own = zip(self.bases, self.space._by_profiles(motion, slopes), strict=True)
        return np.asarray(sum(B[::every].T @ slope for B, slope in own))

    def _limits_at(self, C: Array, sharpness: float) -> tuple[Array, Array]:
        """Smooth maxima of the limits, and their slopes (count, m k)."""
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
        columns = use.reshape(-1, 1) if limit.split == "together" else use
        value, weight = smooth_max(columns, sharpness)
        if limit.split == "by joint":
            # No coefficient is shared, so that one pull serves all columns.
            together = self._coefficients(motion, limit.slopes(motion, weight), limit.every)
            for j in range(len(value)):
                slope = np.zeros(self.shape)
                slope[:, j] = together[:, j]
                yield float(value[j]), slope
            return
        if limit.split == "by moment":
            slopes_at = self._moments(limit, motion, weight * (value >= NEAR))
            yield from zip(value.tolist(), slopes_at, strict=True)
            return
        for j in range(len(value)):
            if value[j] < NEAR:
                yield float(value[j]), np.zeros(self.shape)
                continue
            G = weight if limit.split == "together" else weight * (np.arange(len(value)) == j)
            slopes = limit.slopes(motion, G.reshape(use.shape))
            yield float(value[j]), self._coefficients(motion, slopes, limit.every)

    def _moments(self, limit: Limit, motion: Trajectory, weight: Array) -> Array:
        """Slopes (columns, m, k) of every column, from the samples alone that weigh in it, which
        are few: all columns are looked at in one go."""
        out = np.zeros((weight.shape[1], *self.shape))
        samples, columns = np.nonzero(np.abs(weight) > FAINT)
        if len(samples) == 0:
            return out
        part = _at(motion, samples)
        G = np.zeros((len(samples), weight.shape[1]))
        G[np.arange(len(samples)), columns] = weight[samples, columns]
        by_profiles = self.space._by_profiles(part, limit.slopes(part, G))
        for column in np.unique(columns):
            own = columns == column
            for B, slope in zip(self.bases, by_profiles, strict=True):
                out[column] += B[:: limit.every][samples[own]].T @ slope[own]
        return out


def _at(motion: Trajectory, samples: Array) -> Trajectory:
    t, q, v, a = (array[samples] for array in (motion.t, motion.q, motion.v, motion.a))
    return Trajectory(t, q, v, a)


def _thinned(motion: Trajectory, every: int) -> Trajectory:
    if every == 1:
        return motion
    t, q, v, a = (array[::every] for array in (motion.t, motion.q, motion.v, motion.a))
    return Trajectory(t, q, v, a)
