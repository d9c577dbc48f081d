"""Steps of a model with their derivatives by the state and by beta: sensitivity equations.

With tau(q, v, a, beta) = M a + bias, the acceleration has the derivatives -M^-1 d tau / d q,
-M^-1 d tau / d v and -M^-1 Y; a step carries them along by the chain rule
(Dickinson, Gelinas 1976). A finite difference by each of r parameters would take r runs instead.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.identification.simulation_based.acceleration_model import AccelerationModel
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of
from sysid_bench.identification.simulation_based.measured_motion import (
    MeasuredMotion,
    friction_columns,
)
from sysid_bench.types import Array, Trajectory

NUDGE: Final = 1e-6
"""Finite-difference step of q and v (rad, rad/s, m, m/s)."""


@dataclass(frozen=True, eq=False)
class _StateSlopes:
    """Positions and rates q, v (S, n) of S states, and their derivatives (S, n, m), of which the
    last r are by beta."""

    q: Array
    v: Array
    dq: Array
    dv: Array


def start_state(q: Array, v: Array, r: int) -> _StateSlopes:
    """Return states (S, n) with their derivatives by themselves and by beta: m = 2 n + r."""
    S, n = q.shape
    ones = np.broadcast_to(np.eye(2 * n, 2 * n + r), (S, 2 * n, 2 * n + r))
    return _StateSlopes(q, v, ones[:, :n], ones[:, n:])


@dataclass(frozen=True, eq=False)
class SensitivityModel:
    """A forward model along a measured motion, with one beta (r,) for all states."""

    forward: AccelerationModel
    measured: MeasuredMotion
    beta: Array

    def step(self, x: _StateSlopes, at: Array) -> _StateSlopes:
        """Return the states one step after the samples `at` (S,), by Heun's rule."""
        parts = self.forward.substeps
        for k in range(parts):
            x = self._heun(x, at, (k / parts, (k + 1) / parts))
        return x

    def _heun(self, x: _StateSlopes, at: Array, part: tuple[float, float]) -> _StateSlopes:
        """Return the states after one of the steps between two samples."""
        h = self.forward.dt / self.forward.substeps
        a, da = self._acceleration(x, at, part[0])
        there = _StateSlopes(
            x.q + h * x.v + 0.5 * h * h * a,
            x.v + h * a,
            x.dq + h * x.dv + 0.5 * h * h * da,
            x.dv + h * da,
        )
        b, db = self._acceleration(there, at, part[1])
        return _StateSlopes(
            x.q + h * x.v + h * h / 6 * (2 * a + b),
            x.v + 0.5 * h * (a + b),
            x.dq + h * x.dv + h * h / 6 * (2 * da + db),
            x.dv + 0.5 * h * (da + db),
        )

    @cached_property
    def _smooth(self) -> Array:
        """beta (r,) without friction and features, whose jumps have no derivative."""
        beta = self.beta.copy()
        beta[friction_columns(self.forward.experiment)] = 0.0
        return beta

    def _acceleration(self, x: _StateSlopes, at: Array, share: float) -> tuple[Array, Array]:
        """Acceleration (S, n) between the samples `at` and the next, and its derivative."""
        betas = np.broadcast_to(self.beta, (len(x.q), len(self.beta)))
        before = self.measured.torque_without_friction(at, betas)
        tau = before + share * (self.measured.torque_without_friction(at + 1, betas) - before)
        given = self.measured.at_standstill(at)
        a, M = self.forward.solve_acceleration(self.measured.rigid(betas), x.q, x.v, tau, given)
        Y = self._regressor(x, a, at, share)
        by_q, by_v = self._slopes(x, a)
        change = np.einsum("sij,sjm->sim", by_q, x.dq) + np.einsum("sij,sjm->sim", by_v, x.dv)
        change[:, :, -Y.shape[2] :] += Y
        if given is not None:
            change[given[0]] = 0.0
        return a, -np.linalg.solve(M, change)

    def _regressor(self, x: _StateSlopes, a: Array, at: Array, share: float) -> Array:
        """Base regressor (S, n, r), that of friction along the measured motion where it follows
        it."""
        motion = Trajectory(np.zeros(len(a)), x.q, x.v, a)
        Y = regressor_of(self.forward.experiment, motion)
        columns, friction = self.measured.columns, self.measured.friction
        Y[:, :, columns] = (1 - share) * friction[at] + share * friction[at + 1]
        return Y

    def _slopes(self, x: _StateSlopes, a: Array) -> tuple[Array, Array]:
        """Derivatives (S, n, n) of the torque by q and v."""
        S, n = x.q.shape
        steps = NUDGE * np.concatenate([np.zeros((1, 2 * n)), np.eye(2 * n)])
        q = (x.q[:, None] + steps[:, :n]).reshape(-1, n)
        v = (x.v[:, None] + steps[:, n:]).reshape(-1, n)
        motion = Trajectory(np.zeros(len(q)), q, v, np.repeat(a, 2 * n + 1, axis=0))
        betas = np.broadcast_to(self._smooth, (len(q), len(self.beta)))
        tau = self.forward.torque(betas, motion).reshape(S, 2 * n + 1, n)
        slopes = (tau[:, 1:] - tau[:, :1]).transpose(0, 2, 1) / NUDGE
        return slopes[:, :, :n], slopes[:, :, n:]
