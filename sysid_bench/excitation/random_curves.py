"""Random motions from rest to rest: Fourier series with a polynomial, and B-splines."""

from dataclasses import dataclass, field

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.excitation.curves import Curves, curves_of
from sysid_bench.excitation.design_problem import DesignProblem, is_count
from sysid_bench.excitation.scale_to_limits import dense_grid, scale_to_limits
from sysid_bench.types import Array, Trajectory


@dataclass(frozen=True)
class FourierPolynomial:
    """Random Fourier coefficients with a polynomial that makes the motion start and end at rest, at
    the same position (Park 2006)."""

    harmonics: int = 5
    period: float = field(default=5.0, metadata={"unit": "s"})

    def __post_init__(self) -> None:
        """Raise UsageError for settings out of range."""
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

        scale, offset = scale_to_limits(shape, dense_grid(self.period, curves.fastest), brief, rng)
        t = brief.times(self.period)
        x, dx, ddx = shape(t)
        return brief.trajectory(t, offset + scale * x, scale * dx, scale * ddx, curves.kind)


@dataclass(frozen=True)
class BSplines(FourierPolynomial):
    """Quintic B-splines with as many coefficients as a Fourier series of `harmonics`."""

    @property
    def curves(self) -> Curves:
        """Family of curves that the motion is drawn from."""
        return curves_of("b-spline", self.period, self.harmonics)
