"""Search for a motion: sequential quadratic programming (SLSQP, Kraft 1988) over coefficients.

Draws are deterministic. An interrupt, or the end of the budget, leaves the best feasible motion so
far.

Continuation: a search within a narrow box stalls near its start. From the best motion without the
box, and with the box shrunk about its middle step by step, each search starts close to its answer.
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import scipy

from sysid_bench.excitation.design_cost import DesignCost, SearchEnd
from sysid_bench.excitation.limits import Limit
from sysid_bench.types import Array

LOOSE: Final = 120.0
"""Exponent of the smooth maxima in a first search: loose bounds have wide basins."""

TIGHTEST: Final = (400.0, 1000.0)
"""Exponents of the searches after it: bounds 1 % and .4 % inside the limits."""

_SHARPEST: Final = 5000.0
"""Exponent of a motion that is pulled inside: the bounds are 0.2 % inside the limits at most."""

_FULL: Final = 0.9998
"""Use of the limits that such a motion aims at."""

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


@dataclass
class Search:
    """One search over the coefficients of an evaluation, which keeps the best of them."""

    evaluation: DesignCost
    interrupted: bool = False

    def start(self, starts: Sequence[Array], iterations: int) -> list[Array]:
        """Return the ends (m, k) from which a long search is worth its time: that of a short search
        from the first start, with a quarter of the iterations, and the best of all starts."""
        ends = []
        with self._graceful_stop():
            for C in starts:
                ends.append(self._descend(C, LOOSE, max(iterations // 4, 1)))
        if not ends:
            return [starts[0]]
        best = min(range(len(ends)), key=lambda k: ends[k][0])
        return [ends[k][1] for k in dict.fromkeys((0, best))]

    def run_from(self, C: Array, iterations: int) -> Array:
        """Run a long search from the end C (m, k) of a short one, with ever sharper maxima; return
        its end."""
        with self._graceful_stop():
            for sharpness in TIGHTEST:
                C = self._descend(C, sharpness, max(iterations // 2, 1))[1]
        return C

    def nearest_feasible(self, C: Array) -> Array:
        """Return the nearest coefficients (m, k) within the limits, which they use to the last
        0.2 %; the least violating ones where none keeps all limits."""
        return self._restored(C, _SHARPEST, _FULL)

    def solve_bounded(self, C: Array, iterations: int, sharpness: Sequence[float]) -> Array:
        """Run searches from C (m, k), each from the best before, with tight bounds; return the end
        of the last."""
        with self._graceful_stop():
            for s in sharpness:
                C = self._descend(C, s, iterations)[1]
                C = self.evaluation.kept[-1][1] if self.evaluation.kept else C
        return C

    @contextmanager
    def _graceful_stop(self) -> Iterator[None]:
        """Keep the best so far where the budget or the user ends the search."""
        try:
            yield
        except SearchEnd:
            pass
        except KeyboardInterrupt:
            self.interrupted = True

    def bounded_search(self, C: Array, iterations: int) -> None:
        """Run short searches, each within a box around the best coefficients so far.

        The box widens after a gain and shrinks otherwise. Where many limits bind at once, slopes
        predict little far away.
        """
        radius, left = _STEP / 4, iterations
        with self._graceful_stop():
            self.evaluation.evaluate(C)
            while left > 0 and radius > _SMALLEST:
                before = self.evaluation.best
                end = self._descend(C, LOOSE, min(_BURST, left), radius)[1]
                # Step back from `end` towards C until a motion within the limits improves on
                # `before`.
                for share in (1.0, 0.8, 0.6, 0.4, 0.2):
                    self.evaluation.evaluate(C + share * (end - C))
                    if self.evaluation.best < before:
                        break
                left -= _BURST
                C = self.evaluation.kept[-1][1] if self.evaluation.kept else end
                radius *= 1.5 if self.evaluation.best < before - _GAIN else 0.5

    def _descend(
        self, C: Array, sharpness: float, iterations: int, radius: float = np.inf
    ) -> tuple[float, Array]:
        """Return criterion and coefficients at the end of a search from C, at most `radius` of
        scaled coefficients away."""
        # A unit of each scaled coefficient moves its joint by the same share of the limits.
        scale = np.tile(self._scale(), (self.evaluation.shape[0], 1))
        low, high = self.evaluation.space.limits()
        C = np.clip(C, low, high)
        box = np.maximum(low, C - radius * scale), np.minimum(high, C + radius * scale)
        # The coefficients (m, k) at the end of SLSQP, started at C
        start = (C / scale).ravel()
        low, high = (edge / scale for edge in box)

        def unscaled(x: Array) -> Array:
            return np.asarray(x.reshape(self.evaluation.shape) * scale)

        constraint: Any = {
            "type": "ineq",
            "fun": lambda x: 1.0 - self.evaluation.smooth_limits(unscaled(x), sharpness)[0],
            "jac": lambda x: (
                -self.evaluation.smooth_limits(unscaled(x), sharpness)[1] * scale.ravel()
            ),
        }
        steepest = float(np.abs(self.evaluation.gradient(unscaled(start)) * scale).max())
        # SLSQP starts with a unit Hessian: the first step is the gradient itself.
        unit = _STEP / max(steepest, _STEP)
        result = scipy.optimize.minimize(
            lambda x: unit * self.evaluation.value(unscaled(x)),
            start,
            jac=lambda x: unit * self.evaluation.gradient(unscaled(x)).ravel() * scale.ravel(),
            method="SLSQP",
            constraints=[constraint],
            bounds=scipy.optimize.Bounds(low.ravel(), high.ravel()),
            options={"maxiter": iterations, "ftol": 1e-5 * unit},  # type: ignore[call-overload]
        )
        end = self._restored(unscaled(result.x), sharpness)
        # A penalty only ranks the ends of searches; the search itself has constraints.
        over = max(self.evaluation.largest_use(end) - 1.0, 0.0)
        return self.evaluation.criterion_value(end) + 100 * over, end

    def _restored(self, C: Array, sharpness: float, aim: float = 0.995) -> Array:
        """Return the nearest coefficients within the limits, by Newton steps of least norm; the
        least violating ones where none keeps all limits.

        A search cut off by its iterations ends a few per cent outside.
        """
        scale = np.tile(self._scale(), (self.evaluation.shape[0], 1))
        low, high = self.evaluation.space.limits()
        nearest, least = C, np.inf
        for _ in range(_RESTORING):
            value, slope = self.evaluation.smooth_limits(C, sharpness)
            if value.max() < least:
                nearest, least = C, float(value.max())
            if least <= 1.0:
                break
            step = _least_step(slope * scale.ravel(), aim - value, value > 1.0)
            step *= min(1.0, _STEP / np.abs(step).max())
            C = np.clip(C + step.reshape(self.evaluation.shape) * scale, low, high)
        return nearest

    def _scale(self) -> Array:
        space = self.evaluation.space
        return np.asarray(space.brief.v[space.dofs])


def _least_step(J: Array, room: Array, held: Array) -> Array:
    """Return the step x (n,) of least norm for which the constraints `held` (c,) use up their room
    (c,) exactly, J x = room; those that it would break are held, too."""
    while True:
        step = np.linalg.lstsq(J[held], room[held], rcond=1e-3)[0]
        broken = ~held & (J @ step > np.maximum(room, 0.0))
        if not broken.any():
            return np.asarray(step)
        held = held | broken


STEPS: Final = (2.0, 1.5, 1.2)
"""Factors of the limits, the widest first; a search without them precedes."""

_SHARES: Final = (0.27, 0.2, 0.5)
"""Shares of the iterations of each search without the limits, at each step, and within them."""

WIDENED: Final = ("box",)
"""Kinds of limits that a continuation widens: a fixed share of them is a motion about a centre."""


@dataclass(frozen=True)
class Continuation:
    """Least criterion without the widened limits, and True after an interrupt by the user."""

    without: float
    interrupted: bool


def has_continuation(limits: Collection[Limit]) -> bool:
    """Return True if some of the limits are of a kind that a continuation widens."""
    return any(limit.kind in WIDENED for limit in limits)


def run_continuation(evaluation: DesignCost, C: Array, iterations: int) -> Continuation:
    """Search from C (m, k) without the limits of the kinds `WIDENED`, then with these ever tighter.

    The motions found within all limits join those that `evaluation` has kept.
    """
    without, interrupted = np.inf, False
    without_limits, each_step, within = _SHARES
    shares = [without_limits, *[each_step] * len(STEPS), within]
    for factor, share in zip((np.inf, *STEPS, 1.0), shares, strict=True):
        # An evaluation of its own, with the limits of the kinds `WIDENED` `factor` times as wide.
        stage = replace(
            evaluation,
            limits=tuple(scale_limits(evaluation.limits, WIDENED, factor)),
            progress=lambda count, value: None,
            evaluations=0,
            kept=[],
            nearest=(np.inf, ""),
        )
        search, count = Search(stage), max(round(share * iterations), 1)
        # Searches in between are only on the way to the last one, which sharpens its bounds.
        sharpness = TIGHTEST if factor == 1.0 else TIGHTEST[:1]
        if factor == np.inf:
            sharpness = LOOSE, TIGHTEST[0]
        end = search.solve_bounded(C, count, sharpness)
        C = stage.kept[-1][1] if stage.kept else end
        evaluation.evaluations += stage.evaluations
        without = stage.best if factor == np.inf else without
        interrupted = search.interrupted
        if interrupted:
            break
    if factor == 1.0:
        evaluation.kept = sorted([*evaluation.kept, *stage.kept], key=lambda kept: -kept[0])
    return Continuation(float(without), interrupted)


def scale_limits(
    limits: Collection[Limit], kinds: Collection[str], factor: float
) -> Iterator[Limit]:
    """Yield limits with those of these kinds `factor` times as wide; left out where it is
    infinite."""
    for limit in limits:
        if limit.kind not in kinds:
            yield limit
        elif np.isfinite(factor):
            yield _scaled(limit, factor)


def _scaled(limit: Limit, factor: float) -> Limit:
    return replace(
        limit,
        use=lambda motion: limit.use(motion) / factor,
        slopes=lambda motion, G: limit.slopes(motion, G / factor),
    )
