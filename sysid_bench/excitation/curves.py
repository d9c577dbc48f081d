"""Families of curves that are linear in their coefficients: x(t) = B(t) c, one c per joint."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

from sysid_bench.errors import unknown_name
from sysid_bench.types import Array

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
