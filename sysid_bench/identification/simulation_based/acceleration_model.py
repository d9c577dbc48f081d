"""Forward dynamics from the base regressor: accelerations under given torques, for any beta.

Filters evaluate beta that belong to no physical body, which MuJoCo cannot simulate. Mass matrix and
bias come from inverse dynamics, Y(q, v, a) beta plus the torque of the known parameters.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
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
        S, n = q.shape
        unit = np.concatenate([np.zeros((1, n)), np.eye(n)])
        motion = Trajectory(
            np.zeros(S * (n + 1)),
            np.repeat(q, n + 1, axis=0),
            np.repeat(v, n + 1, axis=0),
            np.tile(unit, (S, 1)),
        )
        # Inverse dynamics at a = 0 is the bias; unit accelerations add the columns of M.
        needed = self.torque(np.repeat(beta, n + 1, axis=0), motion).reshape(S, n + 1, n)
        bias, M = needed[:, 0], (needed[:, 1:] - needed[:, :1]).transpose(0, 2, 1)
        rest = tau - bias
        if given is not None:
            follows, known = given
            M, rest = np.where(follows[..., None], np.eye(n), M), np.where(follows, known, rest)
        try:
            return np.linalg.solve(M, rest[..., None])[..., 0], M
        except np.linalg.LinAlgError as error:
            raise EstimationError(
                "The mass matrix of these parameters is singular: what the model lacks, or noise, "
                "has carried them away."
            ) from error

    def torque(self, beta: Array, motion: Trajectory) -> Array:
        """Inverse dynamics (S, n) with one beta (r,) for all samples, or one (S, r) for each."""
        tau = self.experiment.known(motion)
        done = 0
        for Y in self.experiment.regress(motion):
            part = slice(done, done + len(Y))
            tau[part] += Y @ beta if beta.ndim == 1 else (Y @ beta[part, :, None])[..., 0]
            done += len(Y)
        return tau


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
