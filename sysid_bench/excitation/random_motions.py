"""Random motions within the limits of a robot: Fourier series, curves that rest at both ends,
chirps and sines, moves between postures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.excitation.design_problem import (
    MARGIN,
    DesignProblem,
    Shape,
    dense_grid,
    is_count,
    scale_to_limits,
)
from sysid_bench.excitation.design_space import Curves, curves_of
from sysid_bench.types import Array, Trajectory


def _scaled_motion(
    shape: Shape,
    duration: float,
    fastest: float,
    brief: DesignProblem,
    rng: np.random.Generator,
    name: str,
) -> Trajectory:
    """The motion of a shape scaled into the limits, whose highest frequency is `fastest` (Hz)."""
    scale, offset = scale_to_limits(shape, dense_grid(duration, fastest), brief, rng)
    t = brief.times(duration)
    x, dx, ddx = shape(t)
    return brief.trajectory(t, offset + scale * x, scale * dx, scale * ddx, name)


@dataclass(frozen=True)
class Fourier:
    """Fourier series of random coefficients a, b scaled into the limits, `cycles` periods long."""

    harmonics: int = 5
    period: float = field(default=5.0, metadata={"unit": "s"})
    cycles: int = 2

    def __post_init__(self) -> None:
        if not (is_count(self.harmonics) and is_count(self.cycles) and self.period > 0):
            raise UsageError(
                f"{self}: required are harmonics >= 1, cycles >= 1 and a positive period."
            )

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return a motion of `cycles` periods."""
        a, b = rng.normal(size=(2, self.harmonics, brief.nv))
        unit = np.ones(brief.nv), np.zeros(brief.nv)
        grid = dense_grid(self.period, self.harmonics / self.period)
        scale, offset = scale_to_limits(
            lambda t: fourier_profile(t, self.period, a, b, *unit), grid, brief, rng
        )
        t = brief.times(self.cycles * self.period)
        x, dx, ddx = fourier_profile(t, self.period, a, b, scale, offset)
        return brief.trajectory(t, x, dx, ddx, "fourier", self.period)


@dataclass(frozen=True)
class HeldOutFourier(Fourier):
    """Fourier series for validation: period and harmonics differ from those of training."""

    harmonics: int = 4
    period: float = field(default=7.0, metadata={"unit": "s"})
    cycles: int = 1


def fourier_profile(
    t: Array, period: float, a: Array, b: Array, scale: Array, offset: Array
) -> tuple[Array, Array, Array]:
    """Return x, dx, ddx (N, nv) of eq. (8) with coefficients a, b (L, nv) times `scale` (nv,)."""
    w = 2 * np.pi / period * np.arange(1, len(a) + 1)
    sin, cos = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    a, b = a * scale, b * scale
    x = offset + (sin / w) @ a - (cos / w) @ b
    return x, cos @ a + sin @ b, (-sin * w) @ a + (cos * w) @ b


@dataclass(frozen=True)
class Chirp:
    """q_i = q_i0 + A_i sin(2 pi (f_0 t + (f_1 - f_0) t^2 / (2 T)) + phase_i).

    f_0 and f_1 of each joint are drawn from the lowest and the highest third of the range `lowest`
    to `highest` (Hz); T is `duration` (s).
    """

    lowest: float = field(default=0.1, metadata={"unit": "Hz"})
    highest: float = field(default=1.0, metadata={"unit": "Hz"})
    duration: float = field(default=10.0, metadata={"unit": "s"})

    def __post_init__(self) -> None:
        if not (0 < self.lowest < self.highest and self.duration > 0):
            raise UsageError(f"{self}: required are 0 < lowest < highest and a positive duration.")

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return a motion of `duration`, amplitudes scaled into the limits."""
        third = (self.highest - self.lowest) / 3
        start = self.lowest + third * rng.uniform(size=brief.nv)
        rise = (self.highest - third * rng.uniform(size=brief.nv) - start) / self.duration
        phase = rng.uniform(0, 2 * np.pi, brief.nv)

        def shape(t: Array) -> tuple[Array, Array, Array]:
            t = t[:, None]
            angle = 2 * np.pi * (start * t + 0.5 * rise * t**2) + phase
            w, dw = 2 * np.pi * (start + rise * t), 2 * np.pi * rise
            sin, cos = np.sin(angle), np.cos(angle)
            return sin, w * cos, dw * cos - w**2 * sin

        return _scaled_motion(shape, self.duration, self.highest, brief, rng, "chirp")


@dataclass(frozen=True)
class Multisine:
    """q_i = q_i0 + sum_k A_k sin(2 pi f_k t + phase_k).

    Frequencies of each joint are drawn between `lowest` and `highest` (Hz), so that the motion is
    not periodic.
    """

    sines: int = 5
    lowest: float = field(default=0.1, metadata={"unit": "Hz"})
    highest: float = field(default=1.0, metadata={"unit": "Hz"})
    duration: float = field(default=10.0, metadata={"unit": "s"})

    def __post_init__(self) -> None:
        if not (is_count(self.sines) and 0 < self.lowest <= self.highest and self.duration > 0):
            raise UsageError(
                f"{self}: required are sines >= 1, 0 < lowest <= highest and a positive duration."
            )

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return a motion of `duration`, scaled into the limits."""
        size = (self.sines, brief.nv)
        w = 2 * np.pi * rng.uniform(self.lowest, self.highest, size)
        # Amplitudes fall with frequency, so that all sines add similar velocities.
        amplitude = rng.uniform(0.5, 1.0, size) / w
        phase = rng.uniform(0, 2 * np.pi, size)

        def shape(t: Array) -> tuple[Array, Array, Array]:
            angle = w * t[:, None, None] + phase
            sin, cos = amplitude * np.sin(angle), amplitude * np.cos(angle)
            return sin.sum(axis=1), (w * cos).sum(axis=1), (-w * w * sin).sum(axis=1)

        return _scaled_motion(shape, self.duration, self.highest, brief, rng, "multisine")


@dataclass(frozen=True)
class FourierPolynomial:
    """Random Fourier coefficients with a polynomial that makes the motion start and end at rest, at
    the same position (Park 2006)."""

    harmonics: int = 5
    period: float = field(default=5.0, metadata={"unit": "s"})

    def __post_init__(self) -> None:
        if not (is_count(self.harmonics) and self.period > 0):
            raise UsageError(f"{self}: required are harmonics >= 1 and a positive period.")

    @property
    def curves(self) -> Curves:
        """Family of curves that the motion is drawn from."""
        return curves_of("fourier-polynomial", self.period, self.harmonics)

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return a motion of one period, scaled into the limits."""
        curves = self.curves
        C = rng.normal(size=(curves.size, brief.nv))
        C[0] = 0.0

        def shape(t: Array) -> tuple[Array, Array, Array]:
            x, dx, ddx = (B @ C for B in curves.at(t))
            return x, dx, ddx

        return _scaled_motion(shape, self.period, curves.fastest, brief, rng, curves.kind)


@dataclass(frozen=True)
class BSplines(FourierPolynomial):
    """Quintic B-splines with as many coefficients as a Fourier series of `harmonics`."""

    @property
    def curves(self) -> Curves:
        """Family of curves that the motion is drawn from."""
        return curves_of("b-spline", self.period, self.harmonics)


# Peaks of the quintic s(u) = 10 u^3 - 15 u^4 + 6 u^5 on [0, 1]: of s' and of s''.
_QUINTIC_RATE = 1.875
_QUINTIC_CHANGE = 10 / np.sqrt(3)


@dataclass(frozen=True)
class PointToPoint:
    """Synchronous moves between random postures with rests, as fast as the slowest joint allows, on
    the quintic profile s(u) = 10 u^3 - 15 u^4 + 6 u^5."""

    moves: int = 6
    rest: float = field(default=0.2, metadata={"unit": "s"})
    share: ClassVar[float] = MARGIN  # of the limits of velocity and acceleration that a move uses
    name: ClassVar[str] = "ptp"  # of its trajectories

    def __post_init__(self) -> None:
        if not (is_count(self.moves) and self.rest >= 0):
            raise UsageError(f"{self}: required are moves >= 1 and rest >= 0.")

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return a motion through `moves` random postures from rest to rest."""
        margin = 0.5 * (1 - MARGIN) * (brief.high - brief.low)
        points = rng.uniform(brief.low + margin, brief.high - margin, (self.moves + 1, brief.nv))
        steps = np.diff(points, axis=0)
        # The slowest joint sets the duration of a move, by its velocity or its acceleration.
        v, a = self.share * brief.v, self.share * brief.a
        by_velocity = (_QUINTIC_RATE * np.abs(steps) / v).max(axis=1)
        by_acceleration = np.sqrt(_QUINTIC_CHANGE * np.abs(steps) / a).max(axis=1)
        durations = np.asarray(np.maximum(by_velocity, by_acceleration))
        starts = np.concatenate([[0.0], np.cumsum(durations + self.rest)])
        # Two samples more, so that the grid reaches the end of the last move even without a rest.
        t = brief.times(starts[-1] + 2.0 / brief.rate)
        move = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, self.moves - 1)
        u = np.minimum((t - starts[move]) / durations[move], 1.0)[:, None]
        step, T = steps[move], durations[move][:, None]
        x = points[move] + step * u**3 * (10 - 15 * u + 6 * u**2)
        dx = step / T * 30 * u**2 * (1 - u) ** 2
        ddx = step / T**2 * 60 * u * (1 - u) * (1 - 2 * u)
        return brief.trajectory(t, x, dx, ddx, self.name)


@dataclass(frozen=True)
class Static(PointToPoint):
    """Static postures with slow moves between them: gravity and spring parameters alone are
    excited."""

    moves: int = 12
    rest: float = field(default=2.0, metadata={"unit": "s"})
    share: ClassVar[float] = 0.25  # at which gravity makes nearly all of the torque
    name: ClassVar[str] = "static"


# s(u) = 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7 on [0, 1], whose jerk is zero at both ends: peaks of s'
# and of s''.
_SEPTIC_RATE: Final = 2.1875
_SEPTIC_CHANGE: Final = 420 * 0.64 / (16 * np.sqrt(5))

_SHARES: Final = (0.6, 1.4)
"""Range of a move's random duration, relative to `move`."""


@dataclass(frozen=True)
class RandomWaypoints:
    """Joints that move between random points of their ranges, each at its own times and without
    rests.

    `joints` move (none named: all), the others stand in the middle of their range. The motion
    starts after `rest` (s); a move takes about `move` (s), or longer where the limits require it.
    """

    duration: float = field(default=20.0, metadata={"unit": "s"})
    rest: float = field(default=0.0, metadata={"unit": "s"})
    move: float = field(default=1.5, metadata={"unit": "s"})
    joints: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not (self.duration > self.rest >= 0 and self.move > 0):
            raise UsageError(f"{self}: required are 0 <= rest < duration and a positive move.")
        if isinstance(self.joints, str) or not all(isinstance(j, str) for j in self.joints):
            raise UsageError(f"{self}: joints must be a list of names.")

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        """Return the motion; raises UsageError for an unknown joint."""
        t = brief.times(self.duration)
        x = np.tile(0.5 * (brief.low + brief.high), (len(t), 1))
        dx, ddx = np.zeros_like(x), np.zeros_like(x)
        names = [joint.name for joint in brief.joints]
        for name in self.joints:
            if name not in names:
                raise unknown_name("joint", name, names)
        moving = [joint for joint in brief.joints if joint.name in (self.joints or names)]
        dofs = {dof for j in moving for dof in range(j.vadr, j.vadr + len(j.dofs))}
        for i, dof in enumerate(brief.dofs):
            if int(dof) in dofs:
                x[:, i], dx[:, i], ddx[:, i] = self._profile(brief, i, t, rng)
        return brief.trajectory(t, x, dx, ddx, "wander")

    def _profile(
        self, brief: DesignProblem, i: int, t: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        """Return x, dx, ddx (N,) of profile i."""
        middle = 0.5 * (brief.low[i] + brief.high[i])
        reach = 0.5 * MARGIN * (brief.high[i] - brief.low[i])
        x, dx, ddx = np.full(len(t), middle), np.zeros(len(t)), np.zeros(len(t))
        start, position = self.rest, middle
        while start < self.duration:
            target = middle + reach * rng.uniform(-1.0, 1.0)
            step = target - position
            # Peaks of a move over `step` in time T: rate step / T, change step / T^2.
            shortest = max(
                _SEPTIC_RATE * abs(step) / (MARGIN * brief.v[i]),
                np.sqrt(_SEPTIC_CHANGE * abs(step) / (MARGIN * brief.a[i])),
            )
            T = max(self.move * rng.uniform(*_SHARES), shortest)
            during = (t >= start) & (t < start + T)
            u = (t[during] - start) / T
            x[during] = position + step * u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)
            dx[during] = step / T * 140 * (u * (1 - u)) ** 3
            ddx[during] = step / T**2 * 420 * (u * (1 - u)) ** 2 * (1 - 2 * u)
            start, position = start + T, target
        return x, dx, ddx
