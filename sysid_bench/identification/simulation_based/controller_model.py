"""Gains of the simulated controller: those declared, or updated with the simulated inertia.

With the declared gains the closed-loop poles of a simulation move with the inertia of its
parameters. Gautier, Janot and Vandanjon (2013) multiply the gains of each joint by the inertia of
the simulated robot over that of the actual one, so that the poles stay those of the actual robot,
and the simulated motion near the measured one, for any parameters.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sysid_bench.errors import unknown_name
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of
from sysid_bench.types import Array, Controller, Experiment, Recording, Trajectory

GAINS: Final = ("updated", "kept")

POSTURES: Final = 20
"""Postures of the motion over which the inertia of each joint is averaged."""


@dataclass(frozen=True, eq=False)
class _ControlledModel:
    """Simulation of an experiment whose gains are those of the declared controller times `inertia`
    (rows,) of the simulated parameters over `actual`; None: gains as declared."""

    experiment: Experiment
    actual: Array | None

    def simulate(self, theta: Array) -> Recording:
        """Simulate the closed loop with theta (p,)."""
        if self.actual is None:
            return self.experiment.simulate(theta)
        now = joint_inertia(self.experiment, self.experiment.problem.base.K @ theta)
        return self.experiment.simulate(theta, self._controller(now))

    def _controller(self, now: Array) -> Controller:
        """The declared controller with the poles that it has on the actual robot."""
        declared, actual = self.experiment.raw.controller, self.actual
        assert declared is not None
        assert actual is not None
        # Noise may make an inertia negative, for which no gain gives the poles.
        known = (now > 0) & (actual > 0)
        ratio = np.divide(now, actual, out=np.ones_like(now), where=known)
        return replace(declared, kp=declared.kp * ratio, kd=declared.kd * ratio)


def check_controller(gains: str) -> None:
    """Raise UsageError for a word that is not in GAINS."""
    if gains not in GAINS:
        raise unknown_name("gains", gains, GAINS)


def controller_model(experiment: Experiment, gains: str, actual: Array) -> _ControlledModel:
    """Return the simulation with gains "updated" or "kept"; `actual` (r,): base parameters whose
    inertia the declared gains act on. Gains of coupled joints, and of tasks that measure some of
    the torques, are kept. Raises UsageError for another word."""
    check_controller(gains)
    raw = experiment.raw
    alone = raw.q.shape[1] == len(raw.rows) and experiment.problem.rows == raw.rows
    if gains == "kept" or not alone:
        return _ControlledModel(experiment, None)
    return _ControlledModel(experiment, joint_inertia(experiment, actual))


def joint_inertia(experiment: Experiment, beta: Array) -> Array:
    """Diagonal (n,) of the mass matrix of base parameters (r,), mean over the recorded motion."""
    q = experiment.raw.q
    q = q[np.linspace(0, len(q) - 1, min(POSTURES, len(q))).astype(int)]
    n = q.shape[1]
    # Inverse dynamics at rest, with and without a unit acceleration of each joint.
    a = np.tile(np.concatenate([np.zeros((1, n)), np.eye(n)]), (len(q), 1))
    motion = Trajectory(np.zeros(len(a)), np.repeat(q, n + 1, axis=0), np.zeros_like(a), a)
    tau = regressor_of(experiment, motion) @ beta + experiment.known(motion)
    tau = tau.reshape(len(q), n + 1, n)
    return np.asarray((tau[:, 1:] - tau[:, :1]).diagonal(axis1=1, axis2=2).mean(axis=0))
