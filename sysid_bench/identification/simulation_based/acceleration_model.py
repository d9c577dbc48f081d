"""Forward dynamics from the base regressor: accelerations under given torques, for any beta.

Filters evaluate beta that belong to no physical body, which MuJoCo cannot simulate. Mass matrix and
bias come from inverse dynamics, Y(q, v, a) beta plus the torque of the known parameters.
"""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of
from sysid_bench.identification.simulation_based.measured_motion import MeasuredMotion
from sysid_bench.types import Array, Experiment, Trajectory

FAR: Final = 1e6
"""Position or velocity (rad, rad/s, m, m/s) beyond which the model counts as divergent."""


@dataclass(frozen=True, eq=False)
class AccelerationModel:
    """Time steps of a model; q, v, tau (S, n) of S states, each with its own beta (S, r)."""

    experiment: Experiment
    dt: float
    substeps: int = 1

    def step(
        self,
        beta: Array,
        q: Array,
        v: Array,
        tau: tuple[Array, Array],
        given: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:
        """Return q and v (S, n) after dt by Heun's rule, the torque interpolated between those at
        both ends, `tau`.

        `given`: joints (S, n) that follow a known acceleration, and that acceleration (S, n).
        """
        before, after = tau
        h = self.dt / self.substeps
        for k in range(self.substeps):
            one = before + k / self.substeps * (after - before)
            two = before + (k + 1) / self.substeps * (after - before)
            a = self.acceleration(beta, q, v, one, given)
            b = self.acceleration(beta, q + h * v + 0.5 * h * h * a, v + h * a, two, given)
            # q integrates the linear interpolation of the acceleration exactly.
            q = q + h * v + h * h / 6 * (2 * a + b)
            v = v + 0.5 * h * (a + b)
        if not (np.abs(q) < FAR).all() or not (np.abs(v) < FAR).all():
            raise SimulationError("The model diverges with these parameters.")
        return q, v

    def along(
        self, measured: MeasuredMotion, at: Array, beta: Array, state: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Return q and v (S, n) one step after the samples `at` (S,) of a measured motion."""
        tau = (
            measured.torque_without_friction(at, beta),
            measured.torque_without_friction(at + 1, beta),
        )
        return self.step(measured.rigid(beta), *state, tau, measured.at_standstill(at))

    def acceleration(
        self,
        beta: Array,
        q: Array,
        v: Array,
        tau: Array,
        given: tuple[Array, Array] | None = None,
    ) -> Array:
        """Acceleration (S, n): M^-1 (tau - bias), but that of the joints where it is `given`."""
        return self.solve_acceleration(beta, q, v, tau, given)[0]

    def solve_acceleration(
        self, beta: Array, q: Array, v: Array, tau: Array, given: tuple[Array, Array] | None
    ) -> tuple[Array, Array]:
        """Acceleration (S, n), and the matrix (S, n, n) that was solved with: M, with unit rows for
        the joints whose acceleration is `given`."""
        needed = self._needed(beta, q, v)
        bias, M = needed[:, 0], (needed[:, 1:] - needed[:, :1]).transpose(0, 2, 1)
        return acceleration_of(M, tau - bias, given)

    def _needed(self, beta: Array, q: Array, v: Array) -> Array:
        """Torques (S, n + 1, n) of zero and unit accelerations, each state with its own beta."""
        S, n = q.shape
        # Most sigma points of a filter differ in beta alone: their regressor is the first one's.
        same = (q == q[0]).all(axis=1) & (v == v[0]).all(axis=1)
        same[0] = False
        first, rest = np.flatnonzero(same), np.flatnonzero(~same)
        Y, known = self._regressor(q[rest], v[rest], bool(len(first)))
        needed = (Y @ beta[rest, None, :, None])[..., 0] + known
        if not len(first):
            return np.asarray(needed)
        every = np.empty((S, n + 1, n))
        every[rest] = needed
        every[first] = (Y[0] @ beta[first, None, :, None])[..., 0] + known[0]
        return every

    def _regressor(self, q: Array, v: Array, keep: bool) -> tuple[Array, Array]:
        """Base regressor (S, n + 1, n, r) and known torque (S, n + 1, n) of states at zero and unit
        accelerations; those of the first state may be kept, for the process noise at the mean."""
        kept = vars(self).get("kept")
        if kept is not None and len(q) == 1 and np.array_equal(kept[0], [q[0], v[0]]):
            return kept[1], kept[2]
        n, motion = q.shape[1], unit_acceleration(q, v)
        Y = regressor_of(self.experiment, motion).reshape(len(q), n + 1, n, -1)
        known = self.experiment.known(motion).reshape(-1, n + 1, n)
        if keep:
            vars(self)["kept"] = np.array([q[0], v[0]]), Y[:1], known[:1]
        return Y, known

    def torque(self, beta: Array, motion: Trajectory) -> Array:
        """Inverse dynamics (S, n) of one beta (r,) along a motion."""
        tau = self.experiment.known(motion)
        done = 0
        for Y in self.experiment.regress(motion):
            tau[done : done + len(Y)] += Y @ beta
            done += len(Y)
        return tau


def unit_acceleration(q: Array, v: Array) -> Trajectory:
    """Return each of the states q and v (S, n) with zero and with n unit accelerations.

    Inverse dynamics is the bias at zero acceleration; unit accelerations add the columns of M.
    """
    S, n = q.shape
    unit = np.tile(_zero_and_unit(n), (S, 1))
    return Trajectory(np.zeros(len(unit)), q.repeat(n + 1, axis=0), v.repeat(n + 1, axis=0), unit)


@cache
def _zero_and_unit(n: int) -> Array:
    return np.eye(n + 1, n, -1)


def acceleration_of(
    M: Array, force: Array, given: tuple[Array, Array] | None
) -> tuple[Array, Array]:
    """Return the acceleration (S, n) of M (S, n, n) under forces (S, n), and the matrix that was
    solved with: M, with unit rows for the joints whose acceleration is `given`."""
    if given is not None:
        follows, known = given
        M = np.where(follows[..., None], np.eye(M.shape[1]), M)
        force = np.where(follows, known, force)
    try:
        return np.linalg.solve(M, force[..., None])[..., 0], M
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            "The mass matrix of these parameters is singular: what the model lacks, or noise, "
            "has carried them away."
        ) from error


def scalar_joints(experiment: Experiment, what: str) -> int:
    """Return the number of joints; raises UnsupportedError for joints without scalar positions, or
    where some torque is not measured."""
    raw, problem = experiment.raw, experiment.problem
    if raw.q.shape[1] != len(raw.rows):
        raise UnsupportedError(
            f"{what} needs independent hinges and slides; ball, free and coupled joints are not "
            "supported."
        )
    if problem.rows != raw.rows:
        raise UnsupportedError(
            f"{what} needs the torque of every joint; this task measures only some."
        )
    return len(raw.rows)
