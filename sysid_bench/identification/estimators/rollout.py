"""Multiple shooting: open-loop predictions of short segments."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identification.feasibility.simulatable import SimulatableSet, simulatable_set
from sysid_bench.identification.linear.normal_qr import solve, stacked_factor
from sysid_bench.identification.simulation_based.forward_model import ForwardModel, scalar_joints
from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    ModelResult,
    floor_of,
)
from sysid_bench.identification.simulation_based.output_error import TORQUE_CHANGE
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class Rollout:
    """min sum |q - q_s|^2 over beta and the initial states of segments of length `horizon`.

    Multiple shooting (Bock 1983): the model runs over each segment under the measured torques; the
    initial states are eliminated segment by segment. Gauss-Newton from the prior, else from least
    squares; stops at a step below 0.1 standard deviations. Biased: torques between samples are
    interpolated linearly (`substeps` steps of Heun's rule per sample). Segments of 0.2 s keep the
    open-loop error of unstable dynamics small. Assumes white noise on q.
    """

    bias: ClassVar[str] = "torques between samples are interpolated linearly"
    horizon: float = field(default=0.2, metadata={"unit": "s"})
    substeps: int = 1
    iterations: int = 20

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UsageError for a horizon of fewer than 5 samples."""
        scalar_joints(experiment, "A rollout")
        simulatable = simulatable_set(experiment.problem)
        pieces = _pieces(experiment, self.horizon, self.substeps)
        return GaussNewton(self.iterations).run(pieces, simulatable, _start(simulatable))


def _start(simulatable: SimulatableSet) -> Array:
    if simulatable.problem.prior is not None:
        return simulatable.centre
    R = stacked_factor(simulatable.problem)
    return simulatable.nearest(solve(R), R[:-1, :-1])


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Measured positions and torques (S, C, n) of C segments, and their initial states (C, 2 n)."""

    experiment: Experiment
    forward: ForwardModel
    q: Array
    tau: Array
    begin: Array
    approximates = False

    @cached_property
    def floor(self) -> Array:
        """Rounding error of the positions (n,)."""
        return np.asarray(floor_of(self.q.reshape(-1, self.q.shape[-1])))

    @cached_property
    def nudges(self) -> Array:
        """Steps (r,) of beta that change the torques a little."""
        R = stacked_factor(self.experiment.problem)
        return np.asarray(
            TORQUE_CHANGE * np.linalg.norm(R[:, -1]) / np.linalg.norm(R[:, :-1], axis=0)
        )

    def evaluate(self, theta: Array) -> ModelResult:
        """Prediction errors, projected off the initial states."""
        beta = self.experiment.problem.base.K @ theta
        Q, ahead = self._starts(beta)
        return ModelResult(theta, beta, self._unexplained(Q, self.q - ahead))

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (M, n, r) of the predictions, projected off the initial states."""
        # Variable projection: the initial states are eliminated rather than estimated.
        Q, ahead = self._starts(trial.beta)
        betas = trial.beta + np.diag(self.nudges)
        moved = self._run(betas, np.tile(self.begin, (len(betas), 1, 1)))
        columns = [
            self._unexplained(Q, (one - ahead) / nudge)
            for one, nudge in zip(moved, self.nudges, strict=True)
        ]
        return np.stack(columns, axis=-1)

    def _starts(self, beta: Array) -> tuple[Array, Array]:
        """Orthonormal basis (C, S n, 2 n) of the derivative by the initial states, and the
        predictions."""
        S, C, n = self.q.shape
        size = 1e-6 * np.maximum(np.abs(self.begin).max(axis=0), 1e-3)
        begins = self.begin + np.concatenate([np.zeros((1, 2 * n)), np.diag(size)])[:, None]
        runs = self._run(np.tile(beta, (2 * n + 1, 1)), begins)
        slopes = (runs[1:] - runs[0]) / size[:, None, None, None]
        return np.linalg.qr(slopes.transpose(2, 1, 3, 0).reshape(C, S * n, 2 * n))[0], runs[0]

    def _unexplained(self, Q: Array, errors: Array) -> Array:
        """Errors (S, C, n) minus their projection on the basis Q, as (S C, n)."""
        S, C, n = errors.shape
        flat = errors.transpose(1, 0, 2).reshape(C, S * n, 1)
        rest = flat - Q @ (Q.transpose(0, 2, 1) @ flat)
        return np.asarray(rest.reshape(C * S, n))

    def _run(self, betas: Array, begins: Array) -> Array:
        """Predicted positions (P, S, C, n) for P betas (P, r) and initial states (P, C, 2 n)."""
        P, (S, C, n) = len(betas), self.q.shape
        beta = np.repeat(betas, C, axis=0)
        q, v = begins.reshape(P * C, 2 * n)[:, :n], begins.reshape(P * C, 2 * n)[:, n:]
        path = [q]
        for k in range(S - 1):
            tau, after = (np.tile(self.tau[i], (P, 1)) for i in (k, k + 1))
            q, v = self.forward.step(beta, q, v, tau, after)
            path.append(q)
        return np.array(path).reshape(S, P, C, n).transpose(1, 0, 2, 3)


def _pieces(experiment: Experiment, horizon: float, substeps: int) -> _Pieces:
    raw, recording = experiment.raw, experiment.recording
    S = round(horizon * raw.rate) + 1
    C = len(recording) // max(S, 1)
    if S < 6 or C < 1:
        raise UsageError(
            f"A horizon of {horizon} s at {raw.rate} Hz is {S - 1} samples of {len(recording)}; a "
            "segment needs 5, and the recording one segment."
        )
    first = int(np.argmin(np.abs(raw.t - recording.t[0])))
    part = slice(first, first + C * S)
    q, tau = (x[part].reshape(C, S, -1).transpose(1, 0, 2) for x in (raw.q, raw.tau))
    motion = recording.motion
    begin = np.concatenate([motion.q[: C * S : S], motion.v[: C * S : S]], axis=1)
    return _Pieces(experiment, ForwardModel(experiment, 1 / raw.rate, substeps), q, tau, begin)
