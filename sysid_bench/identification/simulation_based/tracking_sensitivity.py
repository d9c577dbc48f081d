"""Sensitivity equations of a simulated closed loop: its positions and torques by beta.

With PD feedback on a motion, M da + (D + kd) dv + (K + kp) dq = -Y dbeta, where K and D are the
derivatives of inverse dynamics by q and v. Integrated along a simulated recording they cost about
one simulation, where finite differences take one for each base parameter. Not exact: motors hold
their torque, may be at their limits, and Coulomb friction jumps between samples.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from sysid_bench.identification.simulation_based.forward_model import (
    AccelerationModel,
    torque_jacobian,
)
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of, samples_of
from sysid_bench.identification.simulation_based.measured_motion import friction_columns
from sysid_bench.types import Array, Experiment, Recording, Trajectory

STEP: Final = 2.5e-3
"""Largest step (s) of the integration, for loops of about 10 Hz."""

CHUNK: Final = 256
"""Samples whose regressors are in memory at a time."""

CREEP: Final = 1e-6
"""Rate (rad/s, m/s) at which Coulomb friction is evaluated."""


def has_sensitivity(experiment: Experiment) -> bool:
    """Return True for hinges and slides without couplings that are all measured."""
    raw, problem = experiment.raw, experiment.problem
    return raw.q.shape[1] == len(raw.rows) and problem.rows == raw.rows


@dataclass(frozen=True, eq=False)
class TrackingSensitivity:
    """The loop of an experiment along its simulated `recording` with base parameters beta (r,)."""

    experiment: Experiment
    recording: Recording
    beta: Array

    def jacobian(self) -> tuple[Array, Array]:
        """Return the derivatives (N, n, r) of positions and torques by beta."""
        N, n = self.recording.q.shape
        dq, dv = np.zeros((2, N, n, len(self.beta)))
        x = np.zeros((2 * n, len(self.beta)))
        for first in range(0, N - 1, CHUNK):
            # Chunks share a sample: the last state of one is the first of the next.
            at = np.arange(first, min(first + CHUNK, N - 1) + 1)
            states = self._integrated(at, x)
            x = states[-1]
            dq[at], dv[at] = states[:, :n], states[:, n:]
        kp, kd = self._gains
        return dq, -kp[:, None] * dq - kd[:, None] * dv

    @property
    def _gains(self) -> tuple[Array, Array]:
        controller = self.recording.controller
        assert controller is not None
        n = self.recording.q.shape[1]
        return np.broadcast_to(controller.kp, n), np.broadcast_to(controller.kd, n)

    @cached_property
    def _forward(self) -> AccelerationModel:
        return AccelerationModel(self.experiment, 1 / self.recording.rate)

    @cached_property
    def _smooth(self) -> Array:
        """beta (r,) without friction and features."""
        beta = self.beta.copy()
        beta[friction_columns(self.experiment)] = 0.0
        return beta

    @cached_property
    def _coulomb(self) -> Array:
        """Coulomb friction (n,)."""
        q = self.recording.q[:1].repeat(2, axis=0)
        rates = np.outer([CREEP, -CREEP], np.ones(q.shape[1]))
        motion = Trajectory(np.zeros(2), q, rates, np.zeros_like(q))
        tau = self._forward.torque(self.beta, motion)
        return np.asarray(np.maximum(0.5 * (tau[0] - tau[1]), 0.0))

    def _integrated(self, at: Array, x: Array) -> Array:
        """Derivatives (S, 2 n, r) of the states at some samples, from those at the first, by the
        trapezoidal rule."""
        parts = max(1, int(np.ceil(1 / self.recording.rate / STEP)))
        h = 1 / self.recording.rate / parts
        by_q, by_v, by_beta = self._linearised(at, parts, h)
        n = by_q.shape[1]
        half = 0.5 * h
        # dq follows from dv at both ends: the equations of a step are those of the n rates.
        ahead = np.linalg.inv(np.eye(n) - half * by_v[1:] - half**2 * by_q[1:])
        from_q = half * (by_q[:-1] + by_q[1:])
        from_v = np.eye(n) + half * by_v[:-1] + half**2 * by_q[1:]
        steps = ahead @ np.concatenate([from_q, from_v], axis=2)
        forced = half * (ahead @ (by_beta[:-1] + by_beta[1:]))
        out = np.empty((len(steps) + 1, *x.shape))
        out[0] = x
        for k, (step, force) in enumerate(zip(steps, forced, strict=True)):
            old, new = out[k], out[k + 1]
            new[n:] = step @ old + force
            new[:n] = old[:n] + half * (old[n:] + new[n:])
        return out[::parts]

    def _linearised(self, at: Array, parts: int, h: float) -> tuple[Array, Array, Array]:
        """Derivatives of the acceleration by q and v (K, n, n) and by beta (K, n, r), at `parts`
        times per sample."""
        motion = samples_of(self.recording.motion, at)
        n = motion.q.shape[1]
        Y = regressor_of(self.experiment, motion)
        tau = Y @ self._smooth + self.experiment.known(motion)
        by_q, by_v = torque_jacobian(self._forward, self._smooth, motion, tau)
        betas = np.broadcast_to(self.beta, (len(at), len(self.beta)))
        _, M = self._forward.solve_acceleration(betas, motion.q, motion.v, tau, None)
        kp, kd = self._gains
        mobility = np.linalg.inv(M)
        forces = np.concatenate([by_q + np.diag(kp), by_v + np.diag(kd), Y], axis=2)
        rates = _between(-mobility @ forces, parts)
        # A jump of 2 fc where v passes zero: a slope over the rates of about one step.
        width = h * np.sqrt((self.recording.motion.a**2).mean(axis=0)) + 1e-9
        near = np.cosh(np.minimum(np.abs(_between(motion.v, parts) / width), 50.0)) ** -2
        friction = _between(mobility, parts) * (self._coulomb / width * near)[:, None]
        return rates[:, :, :n], rates[:, :, n : 2 * n] - friction, rates[:, :, 2 * n :]


def _between(values: Array, parts: int) -> Array:
    """Values (S, ...) at `parts` times per sample, interpolated linearly."""
    shares = np.arange(parts).reshape(-1, *(1,) * (values.ndim - 1)) / parts
    steps = values[:-1, None] + shares * (values[1:] - values[:-1])[:, None]
    return np.concatenate([steps.reshape(-1, *values.shape[1:]), values[-1:]])
