"""Forward dynamics from the base regressor, for any beta, and its derivatives.

Filters evaluate beta that belong to no physical body, which MuJoCo cannot simulate. Mass matrix and
bias come from inverse dynamics, Y(q, v, a) beta plus the torque of the known parameters.

With tau(q, v, a, beta) = M a + bias, the acceleration has the derivatives -M^-1 d tau / d q,
-M^-1 d tau / d v and -M^-1 Y; a step carries them along by the chain rule (Dickinson, Gelinas
1976). A finite difference by each of r parameters would take r runs instead."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from sysid_bench.errors import EstimationError, SimulationError, UnsupportedError
from sysid_bench.identification.simulation_based.gauss_newton import regressor_of
from sysid_bench.identification.simulation_based.measured_motion import MeasuredMotion
from sysid_bench.types import Array, Experiment, Trajectory

FAR: Final = 1e6
"""Position or velocity (rad, rad/s, m, m/s) beyond which the model counts as divergent."""

_SINGULAR: Final = (
    "The mass matrix of these parameters is singular: what the model lacks, or noise, has carried "
    "them away."
)
_DIVERGED: Final = "The model diverges with these parameters."


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
            raise SimulationError(_DIVERGED)
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
        self, beta: Array, q: Array, v: Array, tau: Array, given: tuple[Array, Array] | None = None
    ) -> Array:
        """Acceleration (S, n): M^-1 (tau - bias), but that of the joints where it is `given`."""
        return self.solve_acceleration(beta, q, v, tau, given)[0]

    def solve_acceleration(
        self, beta: Array, q: Array, v: Array, tau: Array, given: tuple[Array, Array] | None
    ) -> tuple[Array, Array]:
        """Acceleration (S, n), and the matrix (S, n, n) that was solved with: M, with unit rows for
        the joints whose acceleration is `given`."""
        motion, shape = unit_acceleration(q, v), (len(q), q.shape[1] + 1, q.shape[1])
        Y = regressor_of(self.experiment, motion).reshape(*shape, -1)
        needed = (Y @ beta[:, None, :, None])[..., 0]
        needed += self.experiment.known(motion).reshape(shape)
        bias, M = needed[:, 0], (needed[:, 1:] - needed[:, :1]).transpose(0, 2, 1)
        return acceleration_of(M, tau - bias, given)

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
    unit = np.tile(np.eye(n + 1, n, -1), (S, 1))
    return Trajectory(np.zeros(len(unit)), q.repeat(n + 1, axis=0), v.repeat(n + 1, axis=0), unit)


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
        raise EstimationError(_SINGULAR) from error


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


NUDGE: Final = 1e-6
"""Finite-difference step of q and v (rad, rad/s, m, m/s)."""

CLOSE: Final = 1e-9
"""Largest difference of compiled rows from the regressor's, relative to their largest entry."""


def compiled_steps(forward: AccelerationModel, measured: MeasuredMotion) -> Any:
    """Return the compiled steps along a measured motion; None where there are none, or where they
    are not those of the experiment's regressor, which may have features or coupled friction."""
    experiment, motion = forward.experiment, measured.motion
    if experiment.forward is None:
        return None
    numbers = {"dt": forward.dt, "substeps": forward.substeps, "nudge": NUDGE, "far": FAR}
    arrays = {name: getattr(measured, name) for name in ("tau", "columns", "friction", "standing")}
    arrays |= {"jumping": measured.jumps, "a": motion.a}
    steps = experiment.forward.along(numbers, arrays)
    if steps is None:
        return None
    # Rows are affine in beta and smooth in the state: three samples that differ would show a gap.
    at = [0, len(motion) // 3, len(motion) - 1]
    few = Trajectory(motion.t[at], motion.q[at], motion.v[at], motion.a[at])
    signals = few.q, few.v, few.a, regressor_of(experiment, few), experiment.known(few)
    for *sample, wanted_Y, wanted in zip(*signals, strict=True):
        Y, known = np.empty(wanted_Y.shape), np.empty(wanted.shape)
        steps.call("model_rows", *map(np.ascontiguousarray, sample), Y, known)
        Y[:, measured.columns] = wanted_Y[:, measured.columns]
        for found, expected in ((Y, wanted_Y), (known, wanted)):
            if not (np.abs(found - expected) <= CLOSE * np.abs(expected).max(initial=0.0)).all():
                return None
    return steps


def check_code(code: int) -> None:
    """Raise the error that a compiled step has returned."""
    if code == 1:
        raise EstimationError(_SINGULAR)
    if code == 2:
        raise SimulationError(_DIVERGED)


@dataclass(frozen=True, eq=False)
class StateSlopes:
    """Positions and rates q, v (S, n) of S states, and their derivatives (S, n, m), of which the
    last r are by beta; the mass matrix M (S, n, n) at the start of the step to them, if any."""

    q: Array
    v: Array
    dq: Array
    dv: Array
    M: Array | None = None


def start_state(q: Array, v: Array, r: int) -> StateSlopes:
    """Return states (S, n) with their derivatives by themselves and by beta: m = 2 n + r."""
    S, n = q.shape
    ones = np.broadcast_to(np.eye(2 * n, 2 * n + r), (S, 2 * n, 2 * n + r))
    return StateSlopes(q, v, ones[:, :n], ones[:, n:])


def compiled_step(steps: Any, beta: Array, x: StateSlopes, at: Array) -> StateSlopes:
    """Return the states one step after the samples `at` (S,), as `SensitivityModel.step`."""
    now = [np.array(part, order="C") for part in (x.q, x.v, x.dq, x.dv)]
    given = np.ascontiguousarray(at, np.int64), np.ascontiguousarray(beta)
    check_code(steps.call("sensitivities", len(at), *given, *now, None))
    return StateSlopes(*now)


@dataclass(frozen=True, eq=False)
class SensitivityModel:
    """A forward model along a measured motion, with one beta (r,) for all states."""

    forward: AccelerationModel
    measured: MeasuredMotion
    beta: Array

    def step(self, x: StateSlopes, at: Array) -> StateSlopes:
        """Return the states one step after the samples `at` (S,), by Heun's rule."""
        parts = self.forward.substeps
        h = self.forward.dt / parts
        for k in range(parts):
            # Heun's rule as in `AccelerationModel.step`, derivatives carried along term by term.
            a, da, M = self._acceleration(x, at, k / parts)
            there = StateSlopes(
                x.q + h * x.v + 0.5 * h * h * a,
                x.v + h * a,
                x.dq + h * x.dv + 0.5 * h * h * da,
                x.dv + h * da,
            )
            b, db, _ = self._acceleration(there, at, (k + 1) / parts)
            x = StateSlopes(
                x.q + h * x.v + h * h / 6 * (2 * a + b),
                x.v + 0.5 * h * (a + b),
                x.dq + h * x.dv + h * h / 6 * (2 * da + db),
                x.dv + 0.5 * h * (da + db),
                M,
            )
        return x

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

    def _acceleration(self, x: StateSlopes, at: Array, share: float) -> tuple[Array, Array, Array]:
        """Acceleration (S, n) between the samples `at` and the next, its derivative, and M."""
        betas = np.broadcast_to(self.beta, (len(x.q), len(self.beta)))
        before = self.measured.torque_without_friction(at, betas)
        tau = before + share * (self.measured.torque_without_friction(at + 1, betas) - before)
        given = self.measured.at_standstill(at)
        # At zero and unit accelerations: (S, n + 1, n, r) and (S, n + 1, n).
        S, n = x.q.shape
        at_rest = unit_acceleration(x.q, x.v)
        Y = regressor_of(self.forward.experiment, at_rest).reshape(S, n + 1, n, -1)
        known = self.forward.experiment.known(at_rest).reshape(S, n + 1, n)
        needed = Y @ self._rigid + known
        M = (needed[:, 1:] - needed[:, :1]).transpose(0, 2, 1)
        a, solved_with = acceleration_of(M, tau - needed[:, 0], given)
        # Y and the known torque are affine in the acceleration.
        Y, known = _at_acceleration(Y, a), _at_acceleration(known, a)
        motion = Trajectory(np.zeros(len(a)), x.q, x.v, a)
        by_q, by_v = torque_jacobian(self.forward, self._smooth, motion, Y @ self._smooth + known)
        columns, friction = self.measured.columns, self.measured.friction
        # Friction follows the measured motion: its columns do not depend on the simulated state.
        Y[:, :, columns] = (1 - share) * friction[at] + share * friction[at + 1]
        change = by_q @ x.dq + by_v @ x.dv
        change[:, :, -Y.shape[2] :] += Y
        if given is not None:
            # A joint at standstill follows its measured acceleration, whatever state and beta are.
            change[given[0]] = 0.0
        return a, -np.linalg.solve(solved_with, change), M


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
    # One-sided: the torque at the state itself is known, which halves the evaluations.
    slopes = (there - tau[:, None]).transpose(0, 2, 1) / NUDGE
    return slopes[:, :, :n], slopes[:, :, n:]


def _at_acceleration(values: Array, a: Array) -> Array:
    """Values (S, n, ...) at accelerations a (S, n), of those (S, n + 1, n, ...) at zero and unit
    accelerations."""
    S, n = a.shape
    columns = (values[:, 1:] - values[:, :1]).reshape(S, n, -1)
    return np.asarray(values[:, 0] + (a[:, None] @ columns).reshape(values[:, 0].shape))
