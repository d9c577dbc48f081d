"""Motions that a search chooses from: coefficients of curves for some degrees of freedom."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.excitation.curves import Bases, Curves
from sysid_bench.excitation.design_problem import DesignProblem
from sysid_bench.models.coupling.pullback import Slopes, pullback
from sysid_bench.types import Array, Trajectory


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
