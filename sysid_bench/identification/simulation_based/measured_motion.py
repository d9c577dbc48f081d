"""Measured positions and torques that a model is run along, their noise, and their rate.

On a recording, Coulomb friction of a model that runs by itself is stiff, and a joint that stands
still may hold any torque up to its friction. There friction and features take the direction of the
measured rate, as in W, and joints at standstill follow their measured acceleration."""

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Final

import numpy as np

from sysid_bench.identification.feasibility.feasible_set import feasible_set_of, start_of
from sysid_bench.identification.feasibility.lmi_fit import Limits, fit
from sysid_bench.identification.feasibility.simulatable import simulatable_set
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of
from sysid_bench.types import Array, Experiment, Problem, Trajectory

RATE: Final = 500.0
"""Hz; faster recordings are decimated to about it (Leboutet et al. 2021 run filters at 500 Hz to
1 kHz), the torque averaged over the samples that it replaces."""

IN_MODEL: Final = ("fv", "Ia", "k")
"""Joint terms that follow the state of the model, also viscous friction due to another joint (of
"j5.fv.j6" the term is fv): not stiff at such rates."""


SHARE: Final = 0.01
"""Share of the centre of the feasible set in the start."""


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Positions and torques q, tau (N, n) as the sensors gave them, the filtered `motion` at the
    same times and its `rate` (Hz).

    `friction` (N, n, s): base regressor along it of the `columns` (s,) that follow it; `standing`
    (N, n): joints at standstill. Both are empty where the experiment does not judge standstill.
    `jumps` are the base parameters of friction, offsets and features, which jump with the state.
    """

    q: Array
    tau: Array
    motion: Trajectory
    rate: float
    columns: Array
    friction: Array
    standing: Array
    jumps: Array

    def __len__(self) -> int:
        return len(self.q)

    def torque_without_friction(self, at: Array, beta: Array) -> Array:
        """Return the torques (S, n) of the samples `at` (S,) less the friction of beta (S, r)."""
        if not len(self.columns):
            return np.asarray(self.tau[at])
        part = beta[:, self.columns]
        return np.asarray(self.tau[at] - np.einsum("sij,sj->si", self.friction[at], part))

    def at_standstill(self, at: Array) -> tuple[Array, Array] | None:
        """Return which joints (S, n) stand still in the step from the samples `at` (S,), and their
        mean measured acceleration; None where no joint ever does."""
        if not self._stands:
            return None
        a = self.motion.a
        return self.standing[at] & self.standing[at + 1], 0.5 * (a[at] + a[at + 1])

    @cached_property
    def _stands(self) -> bool:
        return bool(self.standing.any())

    def rigid(self, beta: Array) -> Array:
        """Return beta (S, r) without what follows the measured motion."""
        rest = beta.copy()
        rest[:, self.columns] = 0.0
        return rest


def measured_motion(experiment: Experiment) -> MeasuredMotion:
    """Return the raw samples that filtering kept, with the filtered motion."""
    raw, recording = experiment.raw, experiment.recording
    first = int(np.argmin(np.abs(raw.t - recording.t[0])))
    part = slice(first, first + len(recording))
    q, tau, motion = raw.q[part], raw.tau[part], recording.motion
    columns = friction_columns(experiment)
    if experiment.moving is None:
        n = tau.shape[1]
        nothing = np.zeros(0, dtype=int), np.zeros((len(q), n, 0)), np.zeros((len(q), n), bool)
        return MeasuredMotion(q, tau, motion, raw.rate, *nothing, jumps=columns)
    step = max(1, round(raw.rate / RATE))
    kept = slice(None, None, step)
    motion = Trajectory(motion.t[kept], motion.q[kept], motion.v[kept], motion.a[kept], motion.name)
    return MeasuredMotion(
        q=q[::step],
        tau=mean_torque(tau, step),
        motion=motion,
        rate=raw.rate / step,
        columns=columns,
        friction=regressor_of(experiment, motion)[:, :, columns],
        standing=~experiment.moving[::step],
        jumps=columns,
    )


def mean_torque(tau: Array, step: int) -> Array:
    """Return every `step`-th torque of tau (N, n), averaged over the `step` sampling periods around
    it: of an even step the two outermost samples count half, so that nothing is delayed."""
    if step == 1:
        return tau
    half = step // 2
    weights = np.ones(2 * half + 1)
    if step % 2 == 0:
        weights[[0, -1]] = 0.5
    padded = np.pad(tau, ((half, half), (0, 0)), "edge")
    count = -(-len(tau) // step)
    parts = [weight * padded[k : k + len(tau) : step][:count] for k, weight in enumerate(weights)]
    return np.asarray(sum(parts) / step)


def friction_columns(experiment: Experiment) -> Array:
    """Return the base parameters (s,) of friction, offsets and features."""
    problem = experiment.problem
    inertial = {column for body in problem.bodies for column in body.columns}
    names = enumerate(problem.base.names)
    chosen = [j for j, name in names if name not in inertial and not is_of_terms(name, IN_MODEL)]
    return np.array(chosen, dtype=int)


def is_of_terms(name: str, terms: tuple[str, ...]) -> bool:
    """True for the parameter "joint.term" or "joint.term.other" of one of some joint terms."""
    return any(name.endswith(f".{term}") or f".{term}." in name for term in terms)


def feasible_start(problem: Problem) -> Array:
    """Return theta (p,) of weighted least squares within the feasible set, with a small share of
    the set's centre: the start on recordings, whose mass matrix is positive definite."""
    feasible = feasible_set_of(problem)
    start = start_of(feasible, problem.prior)
    found = feasible.scale * fit(feasible, problem, Limits(), start).x
    # At the border a body may have no mass at all.
    return np.asarray((1 - SHARE) * found + SHARE * simulatable_set(problem).centre)


ORDER = 6
"""Order of the difference: it removes a smooth motion and keeps white noise."""


def white_noise(x: Array) -> Array:
    """Standard deviation (k,) of white noise on smooth signals x (N, k).

    MAD of the sixth differences over their gain sqrt(C(12, 6)); a motion well below the sampling
    rate does not contribute.
    """
    # The squared coefficients C(6, k)^2 of the difference sum to C(12, 6).
    gain = np.sqrt(comb(2 * ORDER, ORDER))
    # The median ignores the few samples at which friction jumps.
    return np.asarray(np.median(np.abs(np.diff(x, ORDER, axis=0)), axis=0) / (0.6745 * gain))
