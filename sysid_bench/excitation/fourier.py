"""Finite Fourier series (Swevers et al. 1997), in the form of seed 001, eq. (8):

q_i(t) = q_i0 + sum_l a_l^i / (w_f l) sin(w_f l t) - b_l^i / (w_f l) cos(w_f l t),  w_f = 2 pi / T.
"""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.design_problem import DesignProblem, is_count
from sysid_bench.excitation.scale_to_limits import dense_grid, scale_to_limits
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True)
class Fourier:
    """Fourier series of random coefficients a, b scaled into the limits, `cycles` periods long."""

    harmonics: int = 5
    period: float = field(default=5.0, metadata={"unit": "s"})
    cycles: int = 2

    def __post_init__(self) -> None:
        """Raise UsageError for settings out of range."""
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
