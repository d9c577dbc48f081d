"""Multi-frequency sines of seed 000, with velocities and accelerations in closed form."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import DesignProblem, is_count
from sysid_bench.excitation.scale_to_limits import dense_grid, scale_to_limits
from sysid_bench.types import Array, Trajectory


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
        """Raise UsageError for settings out of range."""
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

        scale, offset = scale_to_limits(shape, dense_grid(self.duration, self.highest), brief, rng)
        t = brief.times(self.duration)
        x, dx, ddx = shape(t)
        return brief.trajectory(t, offset + scale * x, scale * dx, scale * ddx, "multisine")
