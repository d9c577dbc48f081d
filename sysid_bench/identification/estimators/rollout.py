"""Multiple shooting: open-loop predictions of short segments."""

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.identification.feasibility.simulatable import (
    FreeSet,
    SimulatableSet,
    simulatable_set,
)
from sysid_bench.identification.linear.least_squares import solve, stacked_factor
from sysid_bench.identification.simulation_based.forward_model import (
    AccelerationModel,
    SensitivityModel,
    compiled_step,
    compiled_steps,
    scalar_joints,
    start_state,
)
from sysid_bench.identification.simulation_based.gauss_newton import (
    GaussNewton,
    Model,
    ModelResult,
    floor_of,
)
from sysid_bench.identification.simulation_based.measured_motion import (
    MeasuredMotion,
    feasible_start,
    measured_motion,
)
from sysid_bench.types import Array, Estimate, Experiment


@dataclass(frozen=True)
class Rollout:
    """min sum |q - q_s|^2 over beta and the initial states of segments of length `horizon`.

    Multiple shooting (Bock 1983): the model runs over each segment under the measured torques; the
    initial states are eliminated segment by segment. Gauss-Newton from the prior, else from least
    squares; stops at a step below 0.1 standard deviations. Biased: torques between samples are
    interpolated linearly (`substeps` steps of Heun's rule per sample). Segments of 0.2 s keep the
    open-loop error of unstable dynamics small. On recordings it starts from feasible least squares,
    at 500 Hz at most; friction follows the measured rate, and joints at standstill their measured
    acceleration (measured_motion.py). Assumes white noise on q.
    """

    bias: ClassVar[str] = "torques between samples are interpolated linearly"
    horizon: float = field(default=0.2, metadata={"unit": "s"})
    substeps: int = 1
    iterations: int = 20

    def fit(self, experiment: Experiment) -> Estimate:
        """Return beta and its covariance; raises EstimationError where no step improves on the
        start, UsageError for a horizon of fewer than 5 samples."""
        scalar_joints(experiment, "A rollout")
        simulatable, start = _start(experiment)
        measured = measured_motion(experiment)
        S = round(self.horizon * measured.rate) + 1
        C = len(measured) // max(S, 1)
        if S < 6 or C < 1:
            raise UsageError(
                f"A horizon of {self.horizon} s at {measured.rate} Hz is {S - 1} samples of "
                f"{len(measured)}; a segment needs 5, and the recording one segment."
            )
        q = measured.q[: C * S].reshape(C, S, -1).transpose(1, 0, 2)
        first, motion = np.arange(0, C * S, S), measured.motion
        # The filtered motion starts the segments; their own best start is eliminated in each
        # evaluation.
        begin = np.concatenate([motion.q[first], motion.v[first]], axis=1)
        forward = AccelerationModel(experiment, 1 / measured.rate, self.substeps)
        pieces = _Pieces(experiment, forward, measured, q, first, begin)
        return GaussNewton(self.iterations).run(pieces, simulatable, start)


def _start(experiment: Experiment) -> tuple[SimulatableSet, Array]:
    """Parameters that may be simulated, and the start (p,)."""
    problem = experiment.problem
    simulatable = simulatable_set(problem)
    if experiment.moving is not None:
        # A model file may be far from the real robot, and it has no friction: feasible least
        # squares starts nearer. From there noise may carry beta out of the feasible set.
        return FreeSet(problem, simulatable.centre), feasible_start(problem)
    if problem.prior is not None:
        return simulatable, simulatable.centre
    R = stacked_factor(problem)
    return simulatable, simulatable.nearest(solve(R), R[:-1, :-1])


@dataclass(frozen=True, eq=False)
class _Pieces:
    """C segments of S samples: measured motion, positions (S, C, n), samples at which the segments
    begin (C,) and their initial states (C, 2 n)."""

    experiment: Experiment
    forward: AccelerationModel
    measured: MeasuredMotion
    q: Array
    first: Array
    begin: Array
    approximates = False
    exact: ClassVar[Model | None] = None

    @cached_property
    def compiled(self) -> Any:
        """Compiled steps; None where there are none."""
        return compiled_steps(self.forward, self.measured)

    @cached_property
    def floor(self) -> Array:
        """Rounding error of the positions (n,)."""
        return np.asarray(floor_of(self.q.reshape(-1, self.q.shape[-1])))

    def evaluate(self, theta: Array) -> ModelResult:
        """Prediction errors, projected off the initial states."""
        beta = self.experiment.problem.base.K @ theta
        ahead, Q, _ = self._run(beta)
        return ModelResult(theta, beta, self._unexplained(Q, self.q - ahead))

    def jacobian(self, trial: ModelResult) -> Array:
        """Derivative (M, n, r) of the predictions, projected off the initial states."""
        # Variable projection: the initial states are eliminated rather than estimated.
        _, Q, slopes = self._run(trial.beta)
        return np.stack([self._unexplained(Q, x) for x in np.moveaxis(slopes, -1, 0)], axis=-1)

    def _unexplained(self, Q: Array, errors: Array) -> Array:
        """Errors (S, C, n) minus their projection on the basis Q, as (S C, n)."""
        S, C, n = errors.shape
        flat = errors.transpose(1, 0, 2).reshape(C, S * n, 1)
        rest = flat - Q @ (Q.transpose(0, 2, 1) @ flat)
        return np.asarray(rest.reshape(C * S, n))

    def _run(self, beta: Array) -> tuple[Array, Array, Array]:
        """Predicted positions (S, C, n), an orthonormal basis (C, S n, 2 n) of their derivative by
        the initial states, and their derivative (S, C, n, r) by beta."""
        kept: tuple[Array, tuple[Array, Array, Array]] | None = vars(self).get("kept")
        # The Jacobian of an accepted step is that of its evaluation.
        if kept is not None and np.array_equal(kept[0], beta):
            return kept[1]
        S, C, n = self.q.shape
        model = SensitivityModel(self.forward, self.measured, beta)
        step = model.step if self.compiled is None else partial(compiled_step, self.compiled, beta)
        x = start_state(self.begin[:, :n], self.begin[:, n:], len(beta))
        path = [x]
        for k in range(S - 1):
            x = step(x, self.first + k)
            path.append(x)
        slopes = np.array([x.dq for x in path])
        by_start = slopes[..., : 2 * n].transpose(1, 0, 2, 3).reshape(C, S * n, 2 * n)
        found = np.array([x.q for x in path]), np.linalg.qr(by_start)[0], slopes[..., 2 * n :]
        vars(self)["kept"] = beta, found
        return found
