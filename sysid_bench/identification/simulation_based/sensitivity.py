"""Steps of a model with their derivatives by the state and by beta: sensitivity equations.

With tau(q, v, a, beta) = M a + bias, the acceleration has the derivatives -M^-1 d tau / d q,
-M^-1 d tau / d v and -M^-1 Y; a step carries them along by the chain rule
(Dickinson, Gelinas 1976). A finite difference by each of r parameters would take r runs instead.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.identification.simulation_based.acceleration_model import (
    AccelerationModel,
    acceleration_of,
    unit_acceleration,
)
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of
from sysid_bench.identification.simulation_based.measured_motion import MeasuredMotion
from sysid_bench.types import Array, Trajectory

NUDGE: Final = 1e-6
"""Finite-difference step of q and v (rad, rad/s, m, m/s)."""


@dataclass(frozen=True, eq=False)
class _StateSlopes:
    """Positions and rates q, v (S, n) of S states, and their derivatives (S, n, m), of which the
    last r are by beta; the mass matrix M (S, n, n) at the start of the step to them, if any."""

    q: Array
    v: Array
    dq: Array
    dv: Array
    M: Array | None = None


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
        a, da, M = self._acceleration(x, at, part[0])
        there = _StateSlopes(
            x.q + h * x.v + 0.5 * h * h * a,
            x.v + h * a,
            x.dq + h * x.dv + 0.5 * h * h * da,
            x.dv + h * da,
        )
        b, db, _ = self._acceleration(there, at, part[1])
        return _StateSlopes(
            x.q + h * x.v + h * h / 6 * (2 * a + b),
            x.v + 0.5 * h * (a + b),
            x.dq + h * x.dv + h * h / 6 * (2 * da + db),
            x.dv + 0.5 * h * (da + db),
            M,
        )

    @cached_property
    def _rigid(self) -> Array:
        """beta (r,) without what follows the measured motion."""
        return np.asarray(self.measured.rigid(self.beta[None])[0])

    @cached_property
    def _smooth(self) -> Array:
        """beta (r,) without friction and features, whose jumps have no derivative."""
        beta = self.beta.copy()
        beta[self.measured.jumps] = 0.0
        return beta

    def _acceleration(self, x: _StateSlopes, at: Array, share: float) -> tuple[Array, Array, Array]:
        """Acceleration (S, n) between the samples `at` and the next, its derivative, and M."""
        betas = np.broadcast_to(self.beta, (len(x.q), len(self.beta)))
        before = self.measured.torque_without_friction(at, betas)
        tau = before + share * (self.measured.torque_without_friction(at + 1, betas) - before)
        given = self.measured.at_standstill(at)
        Y, known = self._regressors(x)
        needed = Y @ self._rigid + known
        M = (needed[:, 1:] - needed[:, :1]).transpose(0, 2, 1)
        a, solved_with = acceleration_of(M, tau - needed[:, 0], given)
        # Y and the known torque are affine in the acceleration.
        Y, known = _at_acceleration(Y, a), _at_acceleration(known, a)
        motion = Trajectory(np.zeros(len(a)), x.q, x.v, a)
        by_q, by_v = torque_jacobian(self.forward, self._smooth, motion, Y @ self._smooth + known)
        columns, friction = self.measured.columns, self.measured.friction
        Y[:, :, columns] = (1 - share) * friction[at] + share * friction[at + 1]
        change = by_q @ x.dq + by_v @ x.dv
        change[:, :, -Y.shape[2] :] += Y
        if given is not None:
            change[given[0]] = 0.0
        return a, -np.linalg.solve(solved_with, change), M

    def _regressors(self, x: _StateSlopes) -> tuple[Array, Array]:
        """Base regressor (S, n + 1, n, r) and known torque (S, n + 1, n) at zero and unit
        accelerations."""
        S, n = x.q.shape
        motion = unit_acceleration(x.q, x.v)
        Y = regressor_of(self.forward.experiment, motion)
        known = self.forward.experiment.known(motion)
        return Y.reshape(S, n + 1, n, -1), known.reshape(S, n + 1, n)


def torque_jacobian(
    forward: AccelerationModel, beta: Array, motion: Trajectory, tau: Array
) -> tuple[Array, Array]:
    """Return the derivatives (S, n, n) by q and v of the torque of beta (r,) along a motion, which
    is tau (S, n)."""
    S, n = tau.shape
    steps = NUDGE * np.eye(2 * n)
    q = (motion.q[:, None] + steps[:, :n]).reshape(-1, n)
    v = (motion.v[:, None] + steps[:, n:]).reshape(-1, n)
    nudged = Trajectory(np.zeros(len(q)), q, v, motion.a.repeat(2 * n, axis=0))
    there = forward.torque(beta, nudged).reshape(S, 2 * n, n)
    slopes = (there - tau[:, None]).transpose(0, 2, 1) / NUDGE
    return slopes[:, :, :n], slopes[:, :, n:]


def _at_acceleration(values: Array, a: Array) -> Array:
    """Values (S, n, ...) at accelerations a (S, n), of those (S, n + 1, n, ...) at zero and unit
    accelerations."""
    S, n = a.shape
    columns = (values[:, 1:] - values[:, :1]).reshape(S, n, -1)
    return np.asarray(values[:, 0] + (a[:, None] @ columns).reshape(values[:, 0].shape))
