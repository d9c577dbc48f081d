"""Motions that a search chooses from: x(t) = B(t) C with curves B of one family for some joints."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from sysid_bench.errors import unknown_name
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.models.coupling.pullback import Slopes, pullback
from sysid_bench.types import Array, Trajectory

Bases = tuple[Array, Array, Array]
"""B, dB, ddB (N, m) at times t (N,)."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Basis functions of one family; `at(t)` returns them, a constant first.

    `fastest` (Hz): highest frequency; `periodic`: the motion continues smoothly after `duration`
    (s).
    """

    kind: str
    at: Callable[[Array], Bases]
    size: int  # m, coefficients per joint
    duration: float
    fastest: float
    periodic: bool

    def grid(self, density: int = 1) -> Array:
        """Return times (N,) with 40 `density` samples per fastest period, without the end of a
        periodic motion, which is its start."""
        count = density * max(80, round(40 * self.fastest * self.duration))
        return np.linspace(0.0, self.duration, count, endpoint=not self.periodic)


def fourier(period: float, harmonics: int) -> Curves:
    """Return finite Fourier series (Swevers et al. 1997; seed 001, eq. (8)), w = 2 pi / period:

    q0 + sum_l a_l / (w l) sin(w l t) - b_l / (w l) cos(w l t); coefficients q0, a, b.
    """
    w = 2 * np.pi / period * np.arange(1, harmonics + 1)

    def at(t: Array) -> Bases:
        sin, cos = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
        one, zero = np.ones((len(t), 1)), np.zeros((len(t), 1))
        return (
            np.hstack([one, sin / w, -cos / w]),
            np.hstack([zero, cos, sin]),
            np.hstack([zero, -sin * w, cos * w]),
        )

    return Curves("fourier", at, 2 * harmonics + 1, period, harmonics / period, True)


def _fourier_polynomial(period: float, harmonics: int) -> Curves:
    """Return Fourier series at rest at both ends (Park 2006).

    A polynomial t ... t^5 cancels each function's velocity and acceleration at both ends, and the
    difference between its ends.
    """
    series = fourier(period, harmonics)
    ends = np.array([0.0, period])
    power = np.arange(1, 6)

    def powers(t: Array) -> Bases:
        u = (t / period)[:, None]
        return (
            u**power,
            power * u ** (power - 1) / period,
            power * (power - 1) * u ** np.maximum(power - 2, 0) / period**2,
        )

    def conditions(bases: Bases) -> Array:
        x, dx, ddx = bases
        return np.vstack([x[1:] - x[:1], period * dx, period**2 * ddx])

    mix = -np.linalg.solve(conditions(powers(ends)), conditions(series.at(ends)))

    def at(t: Array) -> Bases:
        b, p = series.at(t), powers(t)
        return b[0] + p[0] @ mix, b[1] + p[1] @ mix, b[2] + p[2] @ mix

    return Curves("fourier-polynomial", at, series.size, period, series.fastest, False)


_DEGREE: Final = 5
"""Degree of B-splines: jerk is continuous, so that motors and gears are not excited to vibrate."""


def _b_spline(duration: float, harmonics: int) -> Curves:
    """Return quintic B-splines at rest at both ends, with as many coefficients as a Fourier series.

    The first three control points are equal, and so are the last three: velocity and acceleration
    vanish. Coefficients are the offset, and the control points relative to it.
    """
    free = 2 * harmonics + 1
    points = free + 4
    knots = np.concatenate(
        [
            np.zeros(_DEGREE),
            np.linspace(0.0, duration, points - _DEGREE + 1),
            np.full(_DEGREE, duration),
        ]
    )
    # Control points from the m coefficients.
    mix = np.zeros((points, free))
    mix[:, 0] = 1.0
    for k in range(1, free):
        mix[2 + k, k] = 1.0
    mix[-2:, -1] = 1.0
    spline = scipy.interpolate.BSpline(knots, mix, _DEGREE)

    def at(t: Array) -> Bases:
        inside = np.clip(t, 0.0, duration)
        return spline(inside), spline(inside, 1), spline(inside, 2)

    fastest = (points - _DEGREE) / (2 * duration)  # one wave takes two knot spans
    return Curves("b-spline", at, free, duration, fastest, False)


FAMILIES: Final[dict[str, Callable[[float, int], Curves]]] = {
    "fourier": fourier,
    "fourier-polynomial": _fourier_polynomial,
    "b-spline": _b_spline,
}


def curves_of(kind: str, period: float, harmonics: int) -> Curves:
    """Return the family of a name; raises UsageError for another name."""
    if kind not in FAMILIES:
        raise unknown_name("family of curves", kind, FAMILIES)
    return FAMILIES[kind](period, harmonics)


@dataclass(frozen=True, eq=False)
class DesignSpace:
    """Motions x(t) = B(t) C of the k profiles with indices `dofs`, coefficients C (m, k).

    Other independent joints are held at the reference configuration; dependent joints follow.
    """

    brief: DesignProblem
    curves: Curves
    dofs: Array

    def motion(self, C: Array, t: Array) -> Trajectory:
        """Return the motion of coefficients C (m, k) at times t (N,) in s.

        Raises ModelError where a closed chain cannot be closed.
        """
        return self.sampled_motion(C, t, self.curves.at(t))

    def sampled_motion(
        self, C: Array, t: Array, bases: Bases, near: Trajectory | None = None
    ) -> Trajectory:
        """Return the motion of C from bases evaluated before at t (N,).

        `near`: a motion on the same grid, from which closed chains are solved in fewer steps.
        """
        x, dx, ddx = (B @ C for B in bases)
        q = np.tile(self.brief.q0, (len(t), 1))
        v, a = np.zeros((2, len(t), sum(len(joint.dofs) for joint in self.brief.joints)))
        moving = self.v_indices
        q[:, self.q_indices], v[:, moving], a[:, moving] = x, dx, ddx
        period = self.curves.duration if self.curves.periodic else None
        return self.brief.completed(Trajectory(t, q, v, a, self.curves.kind, period), near)

    @property
    def v_indices(self) -> Array:
        """Indices (k,) of the moving degrees of freedom in v."""
        return np.asarray(self.brief.dofs[self.dofs])

    @property
    def q_indices(self) -> list[int]:
        """Indices (k) of the moving degrees of freedom in q."""
        qadr = {joint.vadr: joint.qadr for joint in self.brief.joints}
        return [qadr[int(dof)] for dof in self.v_indices]

    def profile_gradient(self, motion: Trajectory, slopes: Slopes) -> Slopes:
        """Return slopes by x, dx, ddx (N, k) from those by q, v, a (N, nv) of every joint."""
        if self.brief.coupling is not None:
            slopes = pullback(self.brief.coupling, motion, slopes)
        x, dx, ddx = (slope[:, self.v_indices] for slope in slopes)
        return x, dx, ddx

    def limits(self) -> tuple[Array, Array]:
        """Return the lowest and highest coefficients (m, k) that steps of a search may reach.

        A harmonic is at most 4 / pi of the largest value of its curve (a square wave). Neighbours
        in other families may cancel, so these are given three times as much.
        """
        brief, dofs = self.brief, self.dofs
        factor = 4 / np.pi if self.curves.kind == "fourier" else 4.0
        x, dx, ddx = (np.abs(B).max(axis=0)[1:, None] for B in self.curves.at(self.curves.grid()))
        half = 0.5 * (brief.high - brief.low)[dofs]
        largest = np.min([half / x, brief.v[dofs] / dx, brief.a[dofs] / ddx], axis=0)
        high = np.vstack([brief.high[dofs], factor * largest])
        return np.vstack([brief.low[dofs], -factor * largest]), high

    def random(self, rng: np.random.Generator, share: float) -> Array:
        """Return random coefficients (m, k) that use `share` of the tightest limit of every joint.

        Position, velocity and acceleration count; the middle of the motion is drawn within the
        remaining range.
        """
        brief, dofs = self.brief, self.dofs
        bases = self.curves.at(self.curves.grid())
        C = rng.normal(size=(self.curves.size, len(dofs)))
        C[0] = 0.0
        x, dx, ddx = (B @ C for B in bases)
        room = (brief.high - brief.low)[dofs]
        uses = [
            np.ptp(x, axis=0) / room,
            np.abs(dx).max(axis=0) / brief.v[dofs],
            np.abs(ddx).max(axis=0) / brief.a[dofs],
        ]
        C *= share / np.max(uses, axis=0)
        x = bases[0] @ C
        first = brief.low[dofs] + 0.5 * (1 - share) * room - x.min(axis=0)
        last = brief.high[dofs] - 0.5 * (1 - share) * room - x.max(axis=0)
        C[0] = first + rng.uniform(size=len(dofs)) * np.maximum(last - first, 0.0)
        return C
