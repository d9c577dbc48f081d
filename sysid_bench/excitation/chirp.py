"""Chirps: sines of linearly rising frequency, with start and end drawn for each joint."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.excitation.scale_to_limits import dense_grid, scale_to_limits
from sysid_bench.types import Array, Trajectory


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
        """Raise UsageError for settings out of range."""
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

        scale, offset = scale_to_limits(shape, dense_grid(self.duration, self.highest), brief, rng)
        t = brief.times(self.duration)
        x, dx, ddx = shape(t)
        return brief.trajectory(t, offset + scale * x, scale * dx, scale * ddx, "chirp")
