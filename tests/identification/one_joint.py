"""An excitation that moves the last joint alone."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.types import Trajectory


@dataclass(frozen=True)
class OneJoint:
    """A sine on the last joint."""

    def design(self, brief: DesignProblem, rng: np.random.Generator) -> Trajectory:
        t = brief.times(4.0)
        x, dx, ddx = np.zeros((3, len(t), brief.nv))
        amplitude = 0.2 * min(1.0, float(brief.high[-1] - brief.low[-1]))
        x[:] = 0.5 * (brief.low + brief.high)
        x[:, -1] += amplitude * np.sin(2 * t)
        dx[:, -1], ddx[:, -1] = 2 * amplitude * np.cos(2 * t), -4 * amplitude * np.sin(2 * t)
        return brief.trajectory(t, x, dx, ddx, "one joint")
